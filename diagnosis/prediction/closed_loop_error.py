"""A model in the loop with the controller of a recording: simulated against recorded motion.

The excitation of the record drives the loop from the recorded state on, over the longest part of the record without a
gap; no measurement corrects it after that. So an unstable plant is simulated for the length of this part, and all
errors add up that a predictor corrects sample by sample.

    error over floor = rms(recorded - simulated) / rms(simulated with noise - simulated)

The floor is the scatter of the same loop with the model's own noise in it: innovations e of the floor's covariance S,
which the controller sees and which move the state by K e (diagnosis.lack_of_fit.floor), and an initial state as
uncertain as a filtered state is. A counted output has the white noise that its innovations show: a model states more,
so that no test builds on it, and a controller that was given as much would react to it. A correct model has a ratio of
about 1, or less if the model states more noise than there is. So has a model that lacks an effect which is too small to
show in a loop that counteracts all errors: `adequate` is the sharper test, this one says how well the model is suited
for control.

Time offsets of the inputs are as the model states them, up to a fraction of a sample: more than that is a delay, which
a simulation has to take from the model. Inputs that the loop does not give are as recorded.
Source: Ljung, "System identification", 2nd ed., section 16.5; Van den Hof, Annual Reviews in Control 22 (1998) 173.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from math import isfinite
from typing import Any

import numpy as np
from numpy.typing import NDArray

from upright.diagnosis.lack_of_fit.floor import QUIETEST, Innovations
from upright.diagnosis.prediction.closed_loop import Controller, Limit, steps
from upright.diagnosis.prediction.response import Band, responses
from upright.estimators.data.time_scale import time_scale
from upright.estimators.data.white_noise import white_variance
from upright.models.compiler.kernel import Memory
from upright.models.model import Model
from upright.models.segment import Segment

Array = NDArray[np.float64]

DRAWS = 8
"""Simulations of the loop with noise: enough that the record scatters more than the floor."""
SEED = 20
"""Seed of the draws: the same comparison gives the same numbers."""
BEYOND = 5.0
"""Multiple of the recorded range beyond which a simulation has diverged."""
SHORTEST = 5.0
"""Time scales (estimators.data.time_scale; 2 s of the MONOCAB) of a comparison: less shows the initial error alone."""


@dataclass(frozen=True, slots=True)
class Loop:
    """The controller that closed the loop on one recording, from `begins` to `ends` (s from its first sample).

    `controller(model)(time)` is the controller as it was at `time`, s, of the recording, that of a sample between the
    two, with the actuators of a `model` that has none of its own; it needs the outputs `needs` and gives the inputs
    `gives`, or those of them that a model has. `channels` are compared.
    Beyond the `limits` of these channels the vehicle is no longer controlled: a simulation that exceeds them is not
    valid.
    """

    begins: float
    ends: float
    controller: Callable[[Model], Callable[[float], Controller]] = field(repr=False)
    needs: frozenset[str]
    gives: frozenset[str]
    channels: tuple[str, ...]
    limits: tuple[Limit, ...] = ()

    def of_part(self, begin: float) -> Loop:
        """The same on a part of the recording whose first sample is at `begin` s."""
        whole = self.controller

        def controller(model: Model) -> Callable[[float], Controller]:
            at = whole(model)
            return lambda time: at(time + begin)

        return replace(self, begins=self.begins - begin, ends=self.ends - begin, controller=controller)


@dataclass(frozen=True, slots=True)
class ClosedLoop:
    """A simulation in the loop and the record: `time` (m,) s from the recording's first sample, `measured` and
    `simulated` (m,) by channel, the RMS `floor` of their difference by channel. Empty if there is no simulation:
    `reason` says why. `part` (m,) numbers recordings."""

    reason: str = ""
    time: Array = field(default_factory=lambda: np.zeros(0))
    part: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    measured: Mapping[str, Array] = field(default_factory=dict)
    simulated: Mapping[str, Array] = field(default_factory=dict)
    floor: Mapping[str, float] = field(default_factory=dict)

    def rmse(self, channel: str) -> float:
        """Root mean square of recorded less simulated `channel`."""
        return _rms(self.measured[channel] - self.simulated[channel])

    def fit_percent(self, channel: str) -> float:
        """100 % less `rmse` over the channel's own movement about its mean."""
        return float(100.0 * (1.0 - self.rmse(channel) / max(float(np.nanstd(self.measured[channel])), 1e-300)))

    def over_floor(self, channel: str) -> float:
        """`rmse` over what noise alone would make; about 1 for a correct model."""
        return self.rmse(channel) / self.floor[channel]

    def to_json(self) -> dict[str, Any]:
        """`closed_loop` of a model in `compare --json`; without a simulation the reason instead of numbers."""
        return {
            "available": not self.reason,
            "reason": self.reason,
            "seconds": _span(self.time, self.part),
            "fit_percent": {channel: self.fit_percent(channel) for channel in self.measured},
            "rmse": {channel: self.rmse(channel) for channel in self.measured},
            "noise_floor": dict(self.floor),
            "over_floor": {channel: self.over_floor(channel) for channel in self.measured},
            "response": {channel: [each.to_json() for each in bands] for channel, bands in self.response().items()},
        }

    def response(self) -> dict[str, list[Band]]:
        """Gain and phase of the recorded over the simulated signal, by channel and octave."""
        if not len(self.time):
            return {}
        rows = [self.part == number for number in np.unique(self.part)]
        period = float(np.median(np.diff(self.time[rows[0]])))
        return {
            channel: responses(
                [self.measured[channel][each] for each in rows], [simulated[each] for each in rows], period
            )
            for channel, simulated in self.simulated.items()
        }


def closed_loop(
    found: Innovations,
    owners: Sequence[int],
    loops: Sequence[Loop | str],
    *,
    draws: int = DRAWS,
    floor: Mapping[str, float] | None = None,
) -> ClosedLoop:
    """`found` in the loops of the recordings; `owners` gives the recording of each segment. A text in place of a loop
    says why a recording has none: it is left out. Without any loop there is no simulation. Noise is drawn `draws` times
    for the `floor` by channel, if that is not known."""
    parts, reasons = [], []
    for place, loop in enumerate(loops):
        try:
            if isinstance(loop, str):
                raise _NotPossible(loop)
            numbers = [number for number, owner in enumerate(owners) if owner == place]
            parts.append(_one(found, numbers, loop, draws, floor))
        except _NotPossible as error:
            reasons.append(str(error))
    if not parts:
        return ClosedLoop(reason="; ".join(dict.fromkeys(reasons)) or "no controller is known")
    channels = [name for name in parts[0].measured if all(name in part.measured for part in parts)]
    weights = [len(part.time) for part in parts]
    return ClosedLoop(
        time=np.concatenate([part.time for part in parts]),
        part=np.repeat(np.arange(len(parts)), weights),
        measured={name: np.concatenate([part.measured[name] for part in parts]) for name in channels},
        simulated={name: np.concatenate([part.simulated[name] for part in parts]) for name in channels},
        floor={
            name: float(np.sqrt(np.average([part.floor[name] ** 2 for part in parts], weights=weights)))
            for name in channels
        },
    )


class _NotPossible(Exception):
    """A model cannot be simulated in a loop; the message says why."""


def _one(
    found: Innovations, numbers: Sequence[int], loop: Loop, draws: int, floor: Mapping[str, float] | None
) -> ClosedLoop:
    """One recording, whose segments have these `numbers`; `draws` and `floor` as in closed_loop."""
    model = found.problem.model
    lacking = loop.needs - {each.name for each in model.outputs}
    if lacking:
        raise _NotPossible(f"the controller needs {', '.join(sorted(lacking))}, which the model does not have")
    if loop.gives.isdisjoint(each.name for each in model.inputs):
        raise _NotPossible("the controller gives none of the inputs that the model has")
    number, first, last = _rows(found, numbers, loop)
    segment = _part(found.problem.segments[number], last)
    measured = dict(_trajectories(found, loop, segment, segment))
    begin = _filtered(found, number, segment, first)
    controller = loop.controller(model)
    simulated = _run(found, loop, controller, segment, first, begin)
    _check(loop, simulated, segment.time, first)
    limit = {name: BEYOND * float(np.ptp(values[first:])) for name, values in measured.items()}
    for name, values in simulated.items():
        away = np.flatnonzero(~(np.abs(values - measured[name])[first:] < limit[name]))
        if len(away):
            after = segment.time[first + away[0]] - segment.time[first]
            raise _NotPossible(f"with this model the closed loop diverges {after:.1f} s after its start")
    return ClosedLoop(
        time=segment.time[first:],
        measured={name: values[first:] for name, values in measured.items()},
        simulated={name: values[first:] for name, values in simulated.items()},
        floor=floor or _floor(found, loop, controller, segment, first, begin, simulated, limit, draws),
    )


def _floor(
    found: Innovations,
    loop: Loop,
    controller: Callable[[float], Controller],
    segment: Segment,
    first: int,
    begin: Memory,
    simulated: Mapping[str, Array],
    limit: Mapping[str, float],
    draws: int,
) -> dict[str, float]:
    """RMS by channel of the deviation that noise alone makes from the loop `simulated` without noise."""
    random = np.random.default_rng(SEED)
    drawn = [_run(found, loop, controller, segment, first, begin, random) for _ in range(draws)]
    if not all(np.all(np.abs(draw[name][first:]) < BEYOND * limit[name]) for draw in drawn for name in draw):
        raise _NotPossible("with this model noise alone makes the closed loop diverge")
    return {
        name: _rms(np.array([draw[name] - values for draw in drawn])[:, first:]) for name, values in simulated.items()
    }


def _check(loop: Loop, simulated: Mapping[str, Array], time: Array, first: int) -> None:
    """Raises _NotPossible if a limit is exceeded, with the one that is exceeded first."""
    passed = [
        (int(away[0]), limit)
        for limit in loop.limits
        if len(away := np.flatnonzero(np.abs(simulated[limit.channel][first:]) > limit.largest))
    ]
    if passed:
        row, limit = min(passed, key=lambda each: each[0])
        after = time[first + row] - time[first]
        size = f"{limit.channel} exceeds the {limit.factor * limit.largest:.3g} {limit.unit} {limit.meaning}"
        raise _NotPossible(f"with this model in the loop {size}, {after:.1f} s after the start")


def _rows(found: Innovations, numbers: Sequence[int], loop: Loop) -> tuple[int, int, int]:
    """The segment with most of the loop, and its first and last sample that are in it: a record has gaps."""
    shortest = SHORTEST * time_scale(found.problem.model, found.problem.segments)
    longest, most = 0.0, (0, 0, 0)
    for number in numbers:
        time = found.problem.segments[number].time
        first, last = (
            int(np.searchsorted(time, each - 0.25 * found.floor.spacing)) for each in (loop.begins, loop.ends)
        )
        last = min(last, len(time) - 1)
        if first < last and time[last] - time[first] > longest:
            longest, most = float(time[last] - time[first]), (number, first, last)
    if longest < shortest:
        what = "the record has gaps or the vehicle was on its supports after the excitation began"
        raise _NotPossible(f"{what}: less than {shortest:.3g} s are left")
    return most


def _part(segment: Segment, last: int) -> Segment:
    """`segment` up to and including sample `last`."""
    rows, samples = last + 1, segment.earlier + last + 1
    return replace(
        segment,
        time=segment.time[:rows],
        knots=segment.knots[:samples],
        inputs=segment.inputs[:samples],
        measured=segment.measured[:rows],
    )


def _values(found: Innovations) -> Array:
    """Parameter values (np,): time offsets at most a sample away from what the model states, and causal."""
    model, row = found.problem.model, found.floor.spacing
    values = found.fit.values.copy()
    for name in {name for each in model.inputs for name in each.delays}:
        place, stated = found.problem.kernel.index(name), float(model.parameter(name).value)
        values[place] = max(0.0, stated + float(np.clip(values[place] - stated, -row, row)))
    return values


def _filtered(found: Innovations, number: int, segment: Segment, first: int) -> Memory:
    """The model's memory at sample `first`, its state corrected by all samples up to there."""
    task, fit = found.problem, found.fit
    memory, predicted = task.kernel.memory(fit.starts[number]), np.empty_like(segment.measured)
    nothing = np.empty((*predicted.shape, 0))
    task.kernel.proceed(
        segment, _values(found), memory, fit.gain, (), predicted, nothing, last=first, substeps=task.substeps
    )
    return memory


def _run(
    found: Innovations,
    loop: Loop,
    controller: Callable[[float], Controller],
    segment: Segment,
    first: int,
    begin: Memory,
    random: np.random.Generator | None = None,
) -> dict[str, Array]:
    """The loop from sample `first` on, by channel (n,); as recorded before it. With `random`, noise is added."""
    inputs = found.problem.kernel.inputs
    rows = replace(segment, knots=segment.knots.copy(), inputs=segment.inputs.copy(), measured=segment.measured.copy())
    for place, name in enumerate(inputs):
        if name in loop.gives:
            rows.row_knots[first + 1 :, place] = rows.time[first + 1 :]
    memory = begin.copy()
    shocks = None
    if random is not None:
        memory.x += _root(_start_covariance(found)) @ random.standard_normal(len(memory.x))
        kick = np.linalg.cholesky(_shown_covariance(found))
        noise = random.standard_normal((len(rows) - first, len(kick))) @ kick.T
        shocks = noise, noise @ found.floor.gain.T
    task, closed, state = found.problem, controller(float(segment.time[first])), memory.x.data
    with np.errstate(all="ignore"):
        for _ in steps(task, _values(found), rows, memory, closed, first=first, shocks=shocks):
            if not isfinite(sum(state)):
                rows.measured[:] = np.nan
                break
    if shocks is not None:
        rows.measured[-1] += shocks[0][-1]
    return dict(_trajectories(found, loop, rows, segment))


def _shown_covariance(found: Innovations) -> Array:
    """Covariance of the innovations, (ny, ny): the floor's, but a counted output has only the white noise it shows."""
    sensor = np.diag(found.floor.sensor)
    counted = [output.counted for output in found.problem.model.outputs]
    shown = np.minimum(sensor, np.maximum(white_variance(found.errors)[0], QUIETEST**2 * sensor))
    return np.asarray(found.floor.covariance - np.diag(np.where(counted, sensor - shown, 0.0)))


def _start_covariance(found: Innovations) -> Array:
    """Covariance of a filtered state's error, (nx, nx)."""
    floor = found.floor
    return floor.state_covariance - floor.gain @ floor.covariance @ floor.gain.T


def _root(covariance: Array) -> Array:
    values, vectors = np.linalg.eigh(0.5 * (covariance + covariance.T))
    return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0)))


def _trajectories(found: Innovations, loop: Loop, rows: Segment, recorded: Segment) -> Iterator[tuple[str, Array]]:
    """The loop's channels at the times of the samples, from the model's outputs or else its inputs."""
    kernel = found.problem.kernel
    for name in loop.channels:
        if name in kernel.outputs:
            yield name, rows.measured[:, kernel.outputs.index(name)]
        elif name in kernel.inputs:
            place = kernel.inputs.index(name)
            yield name, np.interp(recorded.time, rows.knots[:, place], rows.inputs[:, place])


def _rms(values: Array) -> float:
    return float(np.sqrt(np.nanmean(values**2)))


def _span(time: Array, part: NDArray[np.int64]) -> float:
    """s of all recordings together."""
    return float(sum(np.ptp(time[part == number]) for number in np.unique(part)))
