"""The reading of a table that fits the physics beyond doubt, if it is not the plain one: a question to its user.

The plain reading is kept unless another one is DECISIVE better, predicts better than extrapolation, and does so by the
model's inputs. If several things are wrong, the best reading is taken for granted, and the next one is sought, up to
MOST. An effect that the model lacks is no reason for a question: it makes no unit fit better.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar
from scipy.stats import chi2

from estimators.contract import EstimationError, Status
from estimators.data.segments import AGREEMENT, DataError, channels_of, segments
from estimators.data.time_scale import motion_time
from estimators.readings.readings import Reading, readings
from estimators.readings.score import Score, score
from models.model import Model
from models.natural_time import natural_time
from telemetry.errors import RecordingError
from telemetry.recording import Recording
from telemetry.tables.mapping import Assumption, factor_of

DECISIVE = math.log(1e6)
"""Nats by which another reading must be better: odds of a million to one."""
ROWS = 2000
"""Samples that are looked at: those with the most motion."""
MOST = 3
"""Things that may be wrong at once."""
CHANCE = 0.01
"""Probability with which parameters are farther from their CAD values, of a reading that makes them fit."""
FARTHEST = 1e4
"""Largest factor of an input that is looked for."""


@dataclass(frozen=True, slots=True)
class Question:
    """`together` are the readings that fit, if all of them are taken; `instead` are those of the last one that fit as
    well. `plain` is the score of the table as it is (None if the model cannot be fitted to it), `best` that of the
    readings, both in nats."""

    source: str
    together: tuple[Reading, ...]
    instead: tuple[Reading, ...]
    plain: float | None
    best: float

    @property
    def what(self) -> str:
        """The finding, in words."""
        said = " and ".join(f"{each.channel} {each.words}" for each in self.together)
        other = "".join(f", or {each.channel} {each.words}" for each in self.instead)
        if self.plain is None:
            return f"seems to have {said}{other}: as it is, the model cannot be fitted to it"
        return f"seems to have {said}{other}: read so, the model fits better by {self.best - self.plain:.0f} nats"

    @property
    def remedy(self) -> str:
        """The options that make it so, and the one that insists."""
        options = " ".join(each.option for each in self.together)
        other = "".join(f", or {each.option}" for each in self.instead)
        kept = " ".join(f"--assume {each.channel}={'s' if each.channel == 'time' else 1}" for each in self.together)
        return f"{options}{other}; if it is right as it is: {kept}."

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
    off = _off(model, part, support)
    before, now = plain, part
    taken: list[Reading] = []
    instead: list[Reading] = []
    while len(taken) < MOST:
        known = {*settled, *(each.channel for each in taken)}
        possible = [each for each in readings(model, now, known) if each.channel != "time" or _nearer(each, off)]
        tried = [(found, each) for each in possible if (found := score(model, each.of(now), support))]
        if before is not None and before.off > DECISIVE:
            tried += _factors(model, now, known, support)
        highest = max((found for found, _ in tried), key=lambda each: each.gain, default=None)
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
    if not taken or before is None or before.gain <= 0.0 or not _by_inputs(model, now, before, support):
        return None
    nats = None if plain is None else plain.gain * plain.rows
    return Question(recording.source, tuple(taken), tuple(instead), nats, before.gain * before.rows)


def _better(one: Score, other: Score | None) -> bool:
    return other is None or (one.gain - other.gain) * min(one.rows, other.rows) > DECISIVE


def _off(model: Model, recording: Recording, support: float | None) -> float | None:
    """How many times slower than its natural time the model moves in `recording`; None if that is not known."""
    natural = natural_time(model)
    try:
        moves = motion_time(model, segments(model, [recording], support=support))
    except (EstimationError, RecordingError):
        return None
    return moves / natural if moves and natural else None


def _nearer(reading: Reading, off: float | None) -> bool:
    """Whether the model moves more nearly in its natural time if time is read so."""
    unit = factor_of(reading.how.unit)
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
    usual = 0.5 * float(chi2.isf(CHANCE, max(1, sum(1 for each in model.parameters if each.estimated and each.std))))
    found: list[tuple[Score, Reading]] = []
    for name in dict.fromkeys(each.channel for each in model.inputs if each.channel in recording.values):
        if name in settled:
            continue

        for sign in (1.0, -1.0):

            def reading(logarithm: float, name: str = name, sign: float = sign) -> Reading:
                factor = sign * float(f"{math.exp(logarithm):.4g}")
                words = f"times {factor:.4g}, as in another unit or as a PWM count"
                return Reading(name, Assumption(f"{factor:g}"), words, named=False)

            def cost(logarithm: float, reading: Callable[[float], Reading] = reading) -> float:
                tried = score(model, reading(logarithm).of(recording), support)
                return math.inf if tried is None else -tried.gain * tried.rows

            grid = np.arange(-math.log(FARTHEST), math.log(FARTHEST) + 0.1, math.log(10.0))
            costs = [cost(each) for each in grid.tolist()]
            place = int(np.argmin(costs))
            if not math.isfinite(costs[place]):
                continue
            ends = (grid[max(place - 1, 0)], grid[min(place + 1, len(grid) - 1)])
            best = minimize_scalar(cost, bounds=ends, method="bounded", options={"xatol": 1e-3, "maxiter": 20})
            each = reading(float(best.x))
            tried = score(model, each.of(recording), support)
            if tried and tried.off < usual and (sign < 0.0 or not AGREEMENT[0] < math.exp(best.x) < AGREEMENT[1]):
                found.append((tried, each))
    return found


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
