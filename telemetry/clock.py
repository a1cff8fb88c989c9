"""Time stamps that jitter about a regular clock: were the samples taken at the stamped times, or by the clock?

In a table that was stamped by a computer's own clock, the stamps state when a row was written. The channels show which
of the two it is. Fourth differences leave almost nothing of a motion below a tenth of the sampling rate. Of a sample
that was taken `off` the clock, they leave those of its slope times `off`:

    D4 y = r D4 (y' off) + D4 noise

r is 1 if the samples were taken as stamped, and 0 if they were taken by the clock.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter1d

from upright.telemetry.recording import Recording

Array = NDArray[np.float64]

LEAST = 1e-3
"""RMS jitter, as a share of a period, below which time stamps are regular."""
FOLLOWS = 0.05
"""Share of a stamp's error by which the clock that detects missing samples is corrected."""
AHEAD = 5
"""Samples after a late stamp of which at least one is in time."""
WINDOW = 51
"""Samples of the shortest window over which a clock may change: what is faster is jitter."""
WANDERS = 2.0
"""Ratio of a mean over a window to what jitter makes of it, above which the clock itself changes."""
SMOOTH = 9
"""Samples of the cubic from which a slope is taken."""
BLOCK = 16
"""Samples whose errors are added up before their variance is taken."""
DEVIATIONS = 5.0
"""Standard deviations by which the channels have to contradict the time stamps."""


@dataclass(frozen=True, slots=True)
class Jitter:
    """How far each time stamp is `off` its clock, s (n,), and the `share` of that, 0 to 1, by which the samples were
    not off, with its standard deviation."""

    off: Array
    share: float
    share_error: float

    @property
    def rms(self) -> float:
        """s."""
        return float(np.sqrt(np.mean(self.off**2)))


def with_regular_times(recording: Recording) -> Recording:
    """`recording` with the instants at which its samples were taken, if its channels show with significance that these
    are not its time stamps; its `truncated` then states this, too, and its `stamped_ns` are the time stamps."""
    found = jitter(recording)
    if found is None or found.share < DEVIATIONS * found.share_error:
        return recording
    moved = np.round(1e9 * min(1.0, found.share) * found.off).astype(np.int64)
    share = f"{100.0 * min(1.0, found.share):.0f} ± {100.0 * found.share_error:.1g} %"
    note = (
        f"the time stamps jitter by {1e3 * found.rms:.2g} ms RMS about a regular clock, but the samples do not"
        f" ({share} of it): they are taken as sampled by the clock"
    )
    return replace(
        recording,
        timestamp_ns=recording.timestamp_ns - moved,
        stamped_ns=recording.timestamp_ns,
        truncated="; ".join(filter(None, (recording.truncated, note))),
    )


def jitter(recording: Recording) -> Jitter | None:
    """The estimate from all channels of a recording, weighted by their variances; None if its time stamps are regular,
    or no channel moves."""
    if len(recording) < 2 * WINDOW:
        return None
    found = _off(recording.time)
    if found is None:
        return None
    off, period = found
    weights = shares = 0.0
    for values in recording.values.values():
        estimate = _as_stamped(values, off, period)
        if estimate is not None:
            share, variance = estimate
            shares, weights = shares + (1.0 - share) / variance, weights + 1.0 / variance
    return Jitter(off, shares / weights, weights**-0.5) if weights else None


def _off(time: Array) -> tuple[Array, float] | None:
    """How far each of `time` (n,) is off its clock, (n,), and the period, s; samples may be missing. None if they are
    off by less than LEAST of a period."""
    period = float(np.median(np.diff(time)))
    if np.max(np.abs(np.diff(time) - period)) < LEAST * period:
        return None
    # A late stamp is followed by ones that are not, a missing sample makes all that follow late.
    latest = np.pad(time, (0, AHEAD), constant_values=np.inf)
    stamps = np.min([latest[step : step + len(time)] - step * period for step in range(AHEAD + 1)], axis=0)
    number, clock = np.zeros(len(time)), float(stamps[0])
    for row, stamp in enumerate(stamps.tolist()[1:], start=1):
        steps = max(1.0, float(np.round((stamp - clock) / period)))
        clock += steps * period
        clock += FOLLOWS * (stamp - clock)
        number[row] = number[row - 1] + steps
    period, begin = np.polyfit(number, time, 1)
    off = time - (begin + period * number)
    off = _without_wander(off)
    return (off, float(period)) if np.sqrt(np.mean(off**2)) > LEAST * period else None


def _without_wander(off: Array) -> Array:
    """`off` (n,) without the clock's own slow changes, at every scale at which they exceed what jitter alone makes of a
    mean: to follow jitter would be to make it."""
    jitter, window = float(np.std(off)), WINDOW
    while 8 * window < len(off):
        window *= 4
    while window >= WINDOW:
        slow = uniform_filter1d(off, window, mode="nearest")
        if float(np.std(slow)) > WANDERS * jitter / np.sqrt(window):
            off = off - slow
        window //= 4
    return off


def _as_stamped(values: Array, off: Array, period: float) -> tuple[float, float] | None:
    """The share of `off` by which a channel's samples were off the clock, and its variance; None if the channel does
    not move, or moves in one block alone."""
    from scipy.signal import savgol_filter  # half a second of imports, which not every command needs

    if not np.isfinite(values).all() or np.ptp(values) == 0.0:
        return None
    slope = savgol_filter(values, SMOOTH, 3, deriv=1, delta=period)
    moved, rest = (np.diff(each, 4)[SMOOTH:-SMOOTH] for each in (slope * off, values))
    square = float(moved @ moved)
    if square == 0.0:
        return None
    share = float(moved @ rest) / square
    errors = moved * (rest - share * moved)
    begins = np.arange(0, len(errors), BLOCK)
    blocks, weights = (np.add.reduceat(each, begins) for each in (errors, moved**2))
    # The effective number of independent blocks (Kish): a channel that steps once fits its own share.
    count = float(square**2 / (weights @ weights))
    if count <= 1.0 + 1e-9:
        return None
    variance = float(blocks @ blocks) / square**2 * count / (count - 1.0)
    return (share, variance) if variance > 0.0 else None
