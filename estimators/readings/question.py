"""The reading of a table that fits the physics beyond doubt, if it is not the plain one: a question to its user.

The plain reading is kept unless an angle and its rate contradict each other in it, or another one is DECISIVE better,
predicts better than extrapolation, and does so by the model's inputs. If several things are wrong, the best reading is
taken for granted, and the next one is sought, up to MOST. An effect that the model lacks is no reason for a question:
it makes no unit fit better.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar

from upright.estimators.contract import EstimationError, Status
from upright.estimators.data.segments import AGREEMENT, Contradiction, DataError, channels_of, segments
from upright.estimators.data.time_scale import motion_time
from upright.estimators.readings.readings import Reading, one, readings
from upright.estimators.readings.score import Score, score
from upright.estimators.tails import chi2_isf
from upright.models.model import Model
from upright.models.natural_time import natural_time
from upright.telemetry.errors import RecordingError
from upright.telemetry.options import assumed
from upright.telemetry.recording import Recording
from upright.telemetry.tables.mapping import Assumption, factor_of

DECISIVE = math.log(1e6)
"""Log-likelihood ratio by which another reading must be better: odds of a million to one."""
ROWS = 2000
"""Samples that are looked at: those with the most motion."""
MOST = 3
"""Things that may be wrong at once."""
CHANCE = 0.01
"""Probability with which parameters are farther from their CAD values, of a reading that makes them fit."""
DECADES = 4
"""Powers of ten in either direction among which the factor of an input is looked for."""
FEWER = 500
"""Samples to which it is fitted."""


@dataclass(frozen=True, slots=True)
class Question:
    """`together` are the readings that fit, if all of them are taken; `instead` are those of the last one that fit as
    well. `plain` is the log-likelihood ratio of the table as it is (None if the model cannot be fitted to it), `best`
    that of the readings."""

    source: str
    together: tuple[Reading, ...]
    instead: tuple[Reading, ...]
    plain: float | None
    best: float

    @property
    def what(self) -> str:
        """The finding, in words."""
        said = " and ".join(each.words for each in self.together)
        other = "".join(f", or {each.words}" for each in self.instead)
        if self.plain is None:
            return f"seems to have {said}{other}: as it is, the model cannot be fitted to it"
        higher = f"{self.best - self.plain:.0f} higher"
        return f"seems to have {said}{other}: read so, the log-likelihood of the model is {higher}"

    @property
    def remedy(self) -> str:
        """The options that make it so, and the one that insists."""
        stated: dict[str, list[str]] = {}
        for channel, texts in (item for each in self.together for item in each.stated.items()):
            stated[channel] = [*stated.get(channel, ()), *texts]
        other = "".join(f", or {assumed(each.stated)}" for each in self.instead)
        kept = assumed({name: "s" if name == "time" else "1" for name in stated})
        return f"read it with {assumed(stated)}{other}; if it is right as it is, with {kept}."

    def error(self) -> DataError:
        """The question as the reason why a recording is not used."""
        return DataError(Status.BAD_DATA, self.source, self.what, remedy=self.remedy)


def question(
    model: Model, recordings: Sequence[Recording], settled: Collection[str] = (), support: float | None = None
) -> Question | None:
    """The question that the first of `recordings` raises; None if the plain reading of all of them stands.

    `settled` channels are as their user says. A recording that lacks a channel is none of this function's business.
    """
    for recording in recordings:
        if found := _question(model, recording, settled, support):
            return found
    return None


def _question(model: Model, recording: Recording, settled: Collection[str], support: float | None) -> Question | None:
    names = [name for name in channels_of(model) if name in recording.values]
    if not {each.name for each in model.outputs} <= set(names):
        return None
    part = _with_most_motion(recording, [each.name for each in model.outputs])
    plain = score(model, part, support)
    off, contradictory = _off(model, part, support)
    before, now = plain, part
    taken: list[Reading] = []
    instead: list[Reading] = []
    while len(taken) < MOST:
        known = {*settled, *(name for each in taken for name in each.channels)}
        possible = [each for each in readings(model, now, known) if _nearer(each, off)]
        tried = [(found, each) for each in possible if (found := score(model, each.of(now), support))]
        if before is not None and before.off > DECISIVE:
            tried += _factors(model, now, known, support)
        highest = max((found for found, _ in tried), key=lambda each: each.log_ratio, default=None)
        if highest is None or not _better(highest, before):
            break
        # A unit that has a name is likelier than a factor that fits as well: it comes first.
        (best, first), *others = [(found, each) for found, each in tried if not _better(highest, found)]
        read = first.of(now)
        if read is None:
            break
        instead = [each for _, each in others if each.named or not first.named]
        taken.append(first)
        before, now = best, read
    if not taken or before is None:
        return None
    # What contradicts itself cannot stay as it is; anything else has to be predicted well in another way.
    if not contradictory and not (before.log_ratio > 0.0 and _by_inputs(model, now, before, support)):
        return None
    as_it_is = None if plain is None else plain.log_ratio * plain.rows
    return Question(recording.source, tuple(taken), tuple(instead), as_it_is, before.log_ratio * before.rows)


def _better(one: Score, other: Score | None) -> bool:
    return other is None or (one.log_ratio - other.log_ratio) * min(one.rows, other.rows) > DECISIVE


def _off(model: Model, recording: Recording, support: float | None) -> tuple[float | None, bool]:
    """How many times slower than its natural time the model moves in `recording`, None if that is not known; and
    whether an angle and a rate contradict each other in it."""
    natural = natural_time(model)
    try:
        moves = motion_time(model, segments(model, [recording], support=support))
    except Contradiction:
        return None, True
    except (EstimationError, RecordingError):
        return None, False
    return (moves / natural if moves and natural else None), False


def _nearer(reading: Reading, off: float | None) -> bool:
    """Whether time is read as it is, or the model moves more nearly in its natural time if it is read so."""
    unit = factor_of(dict(reading.changes).get("time", Assumption()).unit)
    return off is None or unit is None or abs(math.log(off * unit.factor)) < abs(math.log(off))


def _by_inputs(model: Model, recording: Recording, found: Score, support: float | None) -> bool:
    """Whether the inputs make the model predict so well; if they rest, it predicts by itself."""
    moving = [each.channel for each in model.inputs if np.nanstd(recording.values.get(each.channel, np.zeros(1))) > 0.0]
    if not moving:
        return True
    values = {**recording.values}
    for name in moving:
        values[name] = np.where(np.isfinite(values[name]), np.nanmean(values[name]), np.nan)
    return _better(found, score(model, replace(recording, values=values), support))


def _factors(
    model: Model, recording: Recording, settled: Collection[str], support: float | None
) -> list[tuple[Score, Reading]]:
    """For each input, the factor with which the parameters are what their CAD values say, as of PWM counts for volts.

    A factor within AGREEMENT may be physics.
    """
    usual = 0.5 * float(chi2_isf(CHANCE, max(1, sum(1 for each in model.parameters if each.estimated and each.std))))
    part = _rows(recording, slice(0, FEWER))
    found: list[tuple[Score, Reading]] = []
    for name in dict.fromkeys(each.channel for each in model.inputs if each.channel in recording.values):
        if name in settled or not np.nanstd(recording[name]) > 0.0:
            continue

        def roughly(factor: float, name: str = name) -> Score | None:
            return score(model, _by_factor(name, factor).of(part), support)

        def tried(factor: float, name: str = name) -> Score | None:
            return score(model, _by_factor(name, factor).of(recording), support)

        factor = _factor(roughly, tried)
        if factor is None or AGREEMENT[0] < factor < AGREEMENT[1]:
            continue
        best = tried(factor)
        if best and best.off < usual:
            found.append((best, _by_factor(name, factor)))
    return found


def _by_factor(name: str, factor: float) -> Reading:
    rounded = f"{factor:.4g}"
    return one(name, Assumption(rounded), f"times {rounded}, as in another unit or as a PWM count", named=False)


def _factor(roughly: Callable[[float], Score | None], tried: Callable[[float], Score | None]) -> float | None:
    """The factor of either sign with the best score: the best power of ten by a few samples, then refined by all."""

    def cost(logarithm: float, sign: float, tried: Callable[[float], Score | None] = tried) -> float:
        found = tried(sign * math.exp(logarithm))
        return math.inf if found is None else -found.log_ratio * found.rows

    grid = math.log(10.0) * np.arange(-DECADES, DECADES + 1.0)
    costs = {(each, sign): cost(each, sign, roughly) for each in grid.tolist() for sign in (1.0, -1.0)}
    middle, sign = min(costs, key=costs.__getitem__)
    if not math.isfinite(costs[middle, sign]):
        return None
    ends = (middle - math.log(10.0), middle + math.log(10.0))
    best = minimize_scalar(cost, args=(sign,), bounds=ends, method="bounded", options={"xatol": 1e-2, "maxiter": 15})
    return sign * math.exp(float(best.x))


def _with_most_motion(recording: Recording, outputs: Sequence[str]) -> Recording:
    """The ROWS samples in which the outputs move most."""
    if len(recording) <= ROWS:
        return recording
    moved = np.zeros(len(recording))
    for name in outputs:
        values = recording[name]
        spread = float(np.nanstd(values))
        if spread > 0.0:
            moved += np.nan_to_num((values - np.nanmean(values)) / spread) ** 2
    energy = np.concatenate(([0.0], np.cumsum(moved)))
    begin = int(np.argmax(energy[ROWS:] - energy[:-ROWS]))
    return _rows(recording, slice(begin, begin + ROWS))


def _rows(recording: Recording, rows: slice) -> Recording:
    values: dict[str, NDArray[np.float64]] = {name: column[rows] for name, column in recording.values.items()}
    stamped = None if recording.stamped_ns is None else recording.stamped_ns[rows]
    return replace(recording, timestamp_ns=recording.timestamp_ns[rows], values=values, stamped_ns=stamped)
