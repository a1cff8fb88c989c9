"""Does the disturbance change during a record? A gust, a train that passes or somebody who steps on is an event.

A sample corrects the estimate of the disturbance at a joint by u = k e, with k the disturbance's row of the filter's
gain and e the innovation. u is white, of the variance k S k', as long as the disturbance does not change. In a part of
n samples the ratio r of the mean square of u to that variance has the log-likelihood ratio

    n (r - 1 - ln r) / 2,

twice which is chi-squared with one degree of freedom if nothing changes and u is Gaussian. It is not Gaussian if it
consists of many small impacts: samples that were not taken when their time stamps say make u far more peaked. So the
dispersion of u^2 is measured on the rest of the record, as the excess of its scatter from part to part over that of a
Gaussian; divided by it, the ratio has an F distribution. Parts of all lengths, each twice as long as the one before,
are tried at steps of half their length; the p-value accounts for all of them (Bonferroni). The ends of the best one are
then moved to where the ratio is largest.
Sources: generalised likelihood ratio of a change of variance: Basseville, Nikiforov, "Detection of abrupt changes"
(1993), sections 2.4 and 7.2; dispersion: McCullagh, Nelder, "Generalized linear models" (1989), section 9.2.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from upright.estimators.data.segments import SHORTEST
from upright.estimators.data.time_scale import time_scale
from upright.estimators.fit.maximum_likelihood import Fit
from upright.estimators.tails import f_sf
from upright.models.random.disturbance import at_joints

Array = NDArray[np.float64]

LEVEL = 1e-3
"""Probability that an event is reported in a record in which nothing changes."""
LEAST = 2.5
"""Time scales that an event lasts at least, 1 s of the MONOCAB: anything shorter is part of the usual disturbance."""
MOST = 0.5
"""Share of a record that an event lasts at most: beyond it the rest would be the event."""
MARGIN = 2.5
"""Time scales before and after an event that are excluded with it, in which the vehicle recovers from it."""


@dataclass(frozen=True, slots=True)
class Event:
    """The disturbance at `joint` has `ratio` times the RMS that it has elsewhere, from `begin` to `end`, s from the
    first sample of `recording`; `p_value` accounts for all parts of the record that were tested."""

    joint: str
    recording: str
    begin: float
    end: float
    ratio: float
    p_value: float

    def to_json(self) -> dict[str, Any]:
        """One of `events` in `diagnose --json`."""
        return {
            "joint": self.joint,
            "recording": self.recording,
            "from": self.begin,
            "to": self.end,
            "times_as_strong": self.ratio,
            "p_value": self.p_value,
        }

    def __str__(self) -> str:
        """`From 22.0 to 26.5 s the disturbance at roll is 4.1 times as strong: an event, not an effect of the
        vehicle.`"""
        return (
            f"From {self.begin:.1f} to {self.end:.1f} s the disturbance at {self.joint} is {self.ratio:.2g} times as"
            " strong: an event, not an effect of the vehicle."
        )


def events(fitted: Fit) -> list[Event]:
    """At most one event per segment and joint, of a fit whose model is otherwise correct."""
    from scipy.signal import lfilter  # half a second of imports, which not every command needs

    task, errors = fitted.problem, fitted.innovations()
    scale, spacing = time_scale(task.model, task.segments), float(np.median(np.diff(task.segments[0].time)))
    shortest = max(SHORTEST, round(LEAST * scale / spacing))
    found: list[Event] = []
    tried = 0
    for joint, place in at_joints(task.model):
        state = task.model.base_states[place]
        row = fitted.gain[place]
        variance = float(row @ fitted.covariance @ row)
        if variance <= 0.0:
            continue
        fading = float(np.exp(-spacing / fitted.values[task.kernel.index(state.correlation_time)]))
        for segment, each in zip(task.segments, errors, strict=True):
            corrected = np.nan_to_num(each @ row)
            squares = corrected**2 / variance
            best, count = _best(squares, shortest)
            tried += count
            if best is not None:
                first, last, log_ratio = best
                filtered = lfilter([1.0], [1.0, -fading], corrected) ** 2
                inside = np.zeros(len(filtered), dtype=bool)
                inside[first:last] = True
                ratio = float(np.sqrt(np.mean(filtered[inside]) / np.mean(filtered[~inside])))
                begin, end = float(segment.time[first]), float(segment.time[last - 1])
                chance = _by_chance(log_ratio, squares[~inside], shortest)
                found.append(Event(joint.name, segment.source, begin, end, ratio, chance))
    tested = [replace(each, p_value=min(1.0, tried * each.p_value)) for each in found]
    return [each for each in tested if each.p_value < LEVEL]


def _by_chance(log_ratio: float, rest: Array, shortest: int) -> float:
    """Probability of so large a log-likelihood ratio if nothing changes, from the scatter of the squares of the `rest`
    (n,) from part to part."""
    parts = len(rest) // shortest
    if parts < 2:
        return 1.0
    means = rest[: parts * shortest].reshape(parts, shortest).mean(axis=1)
    # The mean of n squares of a Gaussian has the variance 2 / n, relative to its own square.
    dispersion = max(1.0, 0.5 * shortest * float(np.var(means, ddof=1) / np.mean(means) ** 2))
    return float(f_sf(2.0 * log_ratio / dispersion, 1, parts - 1))


def _best(squares: Array, shortest: int) -> tuple[tuple[int, int, float] | None, int]:
    """The part of `squares` (n,), of unit mean, that differs most from the rest: its first sample, the one after its
    last, and its log-likelihood ratio; and the number of parts that were tried."""
    sums = np.concatenate(([0.0], np.cumsum(squares)))
    best: tuple[int, int, float] | None = None
    tried = 0
    for first, last in _parts(len(squares), shortest):
        tried += 1
        ratio = float(sums[last] - sums[first]) / (last - first)
        log_ratio = _log_ratio(ratio, last - first)
        if ratio > 1.0 and (best is None or log_ratio > best[2]):
            best = (first, last, log_ratio)
    if best is None:
        return None, tried
    # Ends to a quarter of the shortest part.
    step = max(1, shortest // 4)
    first, last = best[:2]
    reach = last - first
    for low in range(max(0, first - reach), last - shortest + 1, step):
        for high in range(max(low + shortest, first), min(len(squares), last + reach) + 1, step):
            ratio = float(sums[high] - sums[low]) / (high - low)
            log_ratio = _log_ratio(ratio, high - low)
            if ratio > 1.0 and log_ratio > best[2] and high - low <= MOST * len(squares):
                best = (low, high, log_ratio)
    return best, tried


def _parts(samples: int, shortest: int) -> Iterator[tuple[int, int]]:
    length = shortest
    while length <= MOST * samples:
        for first in range(0, samples - length + 1, max(1, length // 2)):
            yield first, first + length
        length *= 2


def _log_ratio(ratio: float, samples: int) -> float:
    return 0.5 * samples * (ratio - 1.0 - float(np.log(max(ratio, 1e-300))))


def pieces(found: Sequence[Event], recording: str, scale: float) -> tuple[tuple[float, float], ...]:
    """The parts to exclude from `recording`, from and to in s from its first sample: its events with MARGIN time scales
    of `scale` s around them."""
    around = MARGIN * scale
    return tuple((each.begin - around, each.end + around) for each in found if each.recording == recording)
