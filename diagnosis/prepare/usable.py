"""Can these recordings distinguish effects at all? If not, they are refused here, in words, before any number looks
valid.

A channel that is missing, stuck, clipped or in degrees is refused by estimators.data.segments. Here it is about the
motion: too short a record contains too few of the slow motions, and in a motion at a single frequency dry, viscous and
quadratic friction are indistinguishable (the correlation of sgn v with v is 0.90, that of v |v| with v 0.98).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from upright.estimators.contract import Status
from upright.estimators.data.quantised import step_of
from upright.estimators.data.segments import DataError, segments
from upright.estimators.data.time_scale import motion_time, time_scale
from upright.models.model import Model
from upright.models.segment import Segment
from upright.models.text.expressions import names_in
from upright.telemetry.recording import Recording

Array = NDArray[np.float64]

SHORTEST = 20.0
"""Times the time scale of the model (estimators.data.time_scale) of free motion in all recordings together, at least: 8
s of the MONOCAB. In less, a slow motion has not been observed often enough to distinguish effects."""
MOTIONS = 94.0
"""Motion times that are sufficient instead: those that a multisine of the MONOCAB has in 15 s. A record of 14.7 s with
a thousand periods of a resonance is long."""
FEWEST = 500
"""Samples of free motion, at least."""
MOVING = 5.0
"""Times the noise of the joint's rate, both averaged over AVERAGE, above which the vehicle counts as moving."""
AVERAGE = 0.25
"""Share of the time scale over which a rate hardly changes, whatever the sampling rate."""
WINDOW = 20
"""Number of such averages in a window."""
ONE_LINE = 0.97
"""Share of the motion's power in one spectral line, including its harmonics, above which it is a single sine."""
LINE = 0.02
"""Divided by the time scale, Hz, half width of a spectral line; wider in short records."""


HELD = 2.0
"""Average number of samples for which a sensor shows the identical value, from which on it is slower than the
sampling."""
COARSE = 4.0
"""Counts by which a quantised value usually moves when it moves; one that moves by fewer repeats of itself."""
BEYOND = 3.0
"""Ratio to the angle of the supports that no vehicle can reach: they carry it, whatever its weight."""


def _in_radians(model: Model, recordings: Sequence[Recording], support: float | None) -> None:
    """Raises DataError if the angle that the supports bound is far beyond them."""
    name = model.joints[0].coordinate if model.joints else ""
    for recording in recordings:
        if support is None or name not in recording.values:
            continue
        largest = float(np.nanmax(np.abs(recording[name]), initial=0.0))
        if largest > BEYOND * support:
            raise DataError(
                Status.BAD_DATA,
                f"channel {name}",
                f"goes up to {largest:.2g}, but the supports carry the vehicle at {support:.2g} rad",
                remedy="convert degrees to rad, or correct the angle of the supports in the vehicle file.",
            )


def check(model: Model, recordings: Sequence[Recording], support: float | None = None) -> None:
    """Raises DataError if `recordings` are not sufficient to determine what `model` lacks."""
    try:
        _check(model, recordings, support)
    except DataError:
        _in_radians(model, recordings, support)  # a better reason, if it applies
        raise


def _check(model: Model, recordings: Sequence[Recording], support: float | None) -> None:
    rows = segments(model, recordings, support=support)
    for place, output in enumerate(model.outputs):
        if not output.counted:
            _not_held(output.name, [segment.measured[:, place] for segment in rows])
    span = sum(segment.duration for segment in rows)
    scale = time_scale(model, rows)
    required, size = needed(model, rows), sum(map(len, rows))
    best = f"preferably a multisine of {2.0 * required:.3g} s"
    if span < required:
        raise DataError(
            Status.TOO_FEW_SAMPLES,
            "recordings",
            f"{span:.3g} s of free motion cannot distinguish effects",
            remedy=f"record {required:.3g} s or more, {best}.",
        )
    if size < FEWEST:
        raise DataError(
            Status.TOO_FEW_SAMPLES,
            "recordings",
            f"{size} samples of free motion cannot distinguish effects",
            remedy=f"record {FEWEST} samples or more, at a higher rate or for longer.",
        )
    moving = {name for joint in model.joints for name in names_in(joint.rate)}
    measured = [place for place, each in enumerate(model.outputs) if each.name in moving]
    if not measured:
        return
    rates = [[(segment.measured[:, place], segment.time) for segment in rows] for place in measured]
    moved = max(sum(moving_time(rate, time, scale) for rate, time in each) for each in rates)
    if moved < required:
        raise DataError(
            Status.TOO_LITTLE_EXCITATION,
            "recordings",
            f"the vehicle moves by more than {MOVING:g} times its sensor's noise for {moved:.3g} s only",
            remedy=f"excite it for {required:.3g} s or more, {best}.",
        )
    # If one rate is a single sine, another one may not be: wheels coast while the body only swings.
    lines = [line_share(rate, time, scale) for each in rates for rate, time in each]
    frequencies = {round(0.5 * scale * frequency / LINE) for share, frequency in lines if share > ONE_LINE}
    if len(frequencies) == 1 and all(share > ONE_LINE for share, _ in lines):
        frequency = lines[0][1]
        raise DataError(
            Status.TOO_LITTLE_EXCITATION,
            "recordings",
            f"the motion is a single sine of {frequency:.2g} Hz, in which most effects are indistinguishable",
            remedy="record a multisine or a sweep, or sines of several frequencies and amplitudes.",
        )


def _not_held(name: str, readings: Sequence[Array]) -> None:
    """Raises DataError if channel `name` holds each of its values for several samples, like a camera sampled faster
    than its frame rate.

    A held value is late by up to a frame, and its error is identical from sample to sample: neither a noise nor a lag.
    """
    moves = np.abs(np.concatenate([np.diff(each) for each in readings]))
    moves = moves[np.isfinite(moves)]
    fresh = moves[moves > 0.0]
    if not len(fresh) or len(moves) < HELD * len(fresh):
        return
    if float(np.median(fresh)) < COARSE * step_of(np.concatenate(readings)):
        return
    raise DataError(
        Status.BAD_DATA,
        f"channel {name}",
        f"holds each value for {len(moves) / len(fresh):.2g} samples: its sensor is slower than the sampling",
        remedy="record one sample per frame of the sensor, at the time when it was taken.",
    )


def needed(model: Model, rows: Sequence[Segment]) -> float:
    """s of motion that `rows` must have, given the time scales of `model` and of its motion."""
    moves = motion_time(model, rows)
    required = SHORTEST * time_scale(model, rows)
    return required if moves is None else min(required, MOTIONS * moves)


def moving_time(signal: Array, time: Array, scale: float) -> float:
    """s for which `signal` (n,) moves by more than its own white noise. The variance of fourth differences is 70 times
    that of the noise. `scale` s is the time scale."""
    known = np.where(np.isfinite(signal), signal, 0.0)
    spacing = float(np.median(np.diff(time)))
    rows, size = max(1, round(AVERAGE * scale / spacing)), WINDOW
    if len(known) < max(size * rows, 20):
        return 0.0
    noise = 1.4826 * float(np.median(np.abs(np.diff(known, 4)))) / np.sqrt(70.0 * rows)
    means = known[: len(known) // (size * rows) * size * rows].reshape(-1, size, rows).mean(axis=2)
    moves = np.std(means, axis=1) > MOVING * noise
    # Faster oscillations show in the individual samples.
    moves |= np.std(known[: means.size * rows].reshape(len(means), -1), axis=1) > MOVING * noise * np.sqrt(rows)
    return float(np.sum(moves) * size * rows * spacing)


def line_share(signal: Array, time: Array, scale: float) -> tuple[float, float]:
    """The share of the signal's power at its strongest frequency and its harmonics, and that frequency, Hz."""
    known = np.where(np.isfinite(signal), signal, 0.0)
    window = np.hanning(len(known))
    power = np.abs(np.fft.rfft((known - np.mean(known)) * window)) ** 2
    frequency = np.fft.rfftfreq(len(known), float(np.median(np.diff(time))))
    peak = float(frequency[int(np.argmax(power))])
    width = max(LINE / scale, 2.5 / (time[-1] - time[0]))
    harmonics = np.maximum(1.0, np.round(frequency / max(peak, frequency[1])))
    near = np.abs(frequency - harmonics * peak) <= width
    # In a broad spectrum the windows of the harmonics would collect a share by chance: only a low line can be detected.
    return float(np.sum(power[near]) / max(np.sum(power), 1e-300)), peak
