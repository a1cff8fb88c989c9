"""A model, its kernel and its data, in the form that all fits share.

The common unknowns are the estimated parameters. The own unknowns of each segment are the initial states that are not
exactly known.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from upright.estimators.budget import UNLIMITED, Budget
from upright.estimators.contract import EstimationError
from upright.estimators.data.segments import segments
from upright.estimators.data.white_noise import white_variance
from upright.estimators.fit.gauss_newton import Block
from upright.models import library
from upright.models.compiler.kernel import Kernel, Progress, Run, compile_model
from upright.models.model import Model
from upright.models.parts import Parameter
from upright.models.random.disturbance import parameters_of
from upright.models.segment import Segment
from upright.models.text.expressions import number
from upright.telemetry.recording import Recording

Array = NDArray[np.float64]

SHORT = 2e-4
"""Share of a sampling period over which a difference approximates a time derivative: 1 microsecond at 200 Hz."""
STEP, DECAY = 0.35, 0.7
"""Largest product of a Runge-Kutta step, s, with the imaginary part of a pole, rad/s, and with its real part, 1/s.

From the stability function R(z) = 1 + z + z^2/2 + z^3/6 + z^4/24 (Hairer, Nørsett, Wanner, "Solving Ordinary
Differential Equations I", section II.1). It damps an undamped oscillation: by 0.02 % of its amplitude in a period at
0.35, by 0.7 % at 0.7, which would pass for a damping ratio of 0.001. At a decay of 0.7 per step the error is 0.3 % of
what is left, which has decayed with the next steps.
"""
MOST = 50
"""Steps per sample, at most."""
SLOWEST = 0.1
"""Least share of the rate from differences of an angle that counts as motion, even if noise explains all of it."""


@dataclass(frozen=True, slots=True)
class Problem:
    """`free` are the indices of the estimated parameters, `own` those of the states whose initial value is fitted for
    each segment, and `spread` (k,) its prior standard deviations. Passes over the data are made within the `budget`."""

    model: Model
    kernel: Kernel
    segments: tuple[Segment, ...]
    free: tuple[int, ...]
    own: tuple[int, ...]
    initials: tuple[Array, ...]
    substeps: int
    spread: Array
    budget: Budget = UNLIMITED

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """The estimated parameters."""
        return tuple(self.model.parameters[place] for place in self.free)

    @property
    def start(self) -> Array:
        return np.array([parameter.value for parameter in self.parameters])

    @property
    def scale(self) -> Array:
        return np.array([parameter.typical for parameter in self.parameters])

    @property
    def bounds(self) -> tuple[Array, Array]:
        return (
            np.array([parameter.lower for parameter in self.parameters]),
            np.array([parameter.upper for parameter in self.parameters]),
        )

    @property
    def rows(self) -> int:
        return sum(map(len, self.segments))

    @property
    def span(self) -> float:
        """Duration of all data, s."""
        return sum(segment.duration for segment in self.segments)

    @property
    def shown(self) -> list[tuple[int, int]]:
        """The initial states that equal an output: index in `own` and index of the output."""
        initials = {place: self.model.states[place].initial for place in self.own}
        outputs = {name: place for place, name in enumerate(self.kernel.outputs)}
        return [(k, outputs[initials[place]]) for k, place in enumerate(self.own) if initials[place] in outputs]

    @property
    def own_start(self) -> list[Array]:
        return [initial[list(self.own)] for initial in self.initials]

    @property
    def uncertain(self) -> tuple[int, ...]:
        """Indices of the parameters that are neither estimated nor exactly known."""
        return tuple(place for place, p in enumerate(self.model.parameters) if place not in self.free and p.std > 0.0)

    def values(self, common: Array) -> Array:
        """All parameter values (np,) if the estimated ones are `common`."""
        values = self.kernel.vector()
        values[list(self.free)] = common
        return values

    def begin(self, initial: Array, part: Array) -> Array:
        """The initial state (nx,) of a segment, `part` (k,) of which is fitted; the rest is as in `initial` (nx,)."""
        start = initial.copy()
        start[list(self.own)] = part
        return start

    def refined(self, common: Array) -> Problem:
        """With steps short enough for the model at `common`: friction that starts at zero makes it stiff later."""
        enough = _substeps(self.model, self.kernel, self.values(common), self.segments)
        return replace(self, substeps=max(self.substeps, enough))

    def like(self, other: Problem) -> Problem:
        """With steps as short as those of `other`, and with its spread of the initial states that both have, which come
        first here."""
        spread = np.concatenate((other.spread, self.spread[len(other.spread) :]))
        return replace(self, substeps=max(self.substeps, other.substeps), spread=spread)

    def off_at_the_start(self, run: Run, initial: Array, part: Array, starts: range) -> tuple[Array, Array]:
        """Deviation (k,) of a segment's initial states `part` (k,) from the measurements of its first sample, each in
        the unit of its state, and its derivatives (k, na) with respect to what is active in `run`; `starts` are the
        columns of `part`.

        `initial` (nx,) are the measured states. If a state equals an output, the measurement is compared with the
        output that the model predicts, errors of the sensor included, so that a misaligned sensor does not make the
        initial state improbable.
        """
        own = list(self.own)
        off, by = part - initial[own], np.zeros((len(own), run.sensitivity.shape[2]))
        by[np.arange(len(own)), list(starts)] = 1.0
        for each, output in self.shown:
            slopes = run.sensitivity[0, output]
            if slopes[starts[each]] != 0.0:
                off[each], by[each] = run.predicted[0, output] - initial[own[each]], slopes
        return off, by

    def evaluate(
        self,
        common: Array,
        own: Sequence[Array],
        *,
        weights: Array,
        gain: Array | None = None,
        slopes: Array | None = None,
        also: Sequence[int] = (),
        by_common: bool = True,
    ) -> list[Block] | None:
        """Weighted errors of every segment, followed by the deviations of its initial state from the prior.

        `weights` (ny, ny) turns an output error into independent ones of unit variance. `also`: indices of further
        parameters to differentiate by, after the estimated ones. `slopes` (nx * ny, p + q) are the derivatives of the
        gain with respect to these and to q further unknowns that act only through the gain. Not `by_common`: only the
        own unknowns are differentiated by, which takes a fraction of the time. None if the model diverges.
        """
        self.budget.check()
        values = self.values(common)
        blocks = []
        free = self.free if by_common else ()
        columns, states = len(free) + len(also), len(self.kernel.states)
        further = 0 if slopes is None else slopes.shape[1] - columns
        starts = tuple(len(self.kernel.parameters) + state for state in self.own)
        gains = range(len(slopes)) if slopes is not None else ()
        active = (*free, *also, *starts, *(len(self.kernel.parameters) + states + entry for entry in gains))
        spread = self.spread
        for segment, initial, part in zip(self.segments, self.initials, own, strict=True):
            start = self.begin(initial, part)
            run = self.kernel.run(segment, values, start, gain=gain, active=active, substeps=self.substeps)
            if run.diverges:
                return None
            error = segment.measured - run.predicted
            residual = (np.where(np.isfinite(error), error, 0.0) @ weights.T).ravel()
            off, by = self.off_at_the_start(run, initial, part, range(columns, columns + len(self.own)))
            residual = np.concatenate((residual, off / spread))
            jacobian = np.zeros((len(residual), columns + further + len(self.own)))
            sensitivity = run.sensitivity
            unknown = ~np.isfinite(error)
            if unknown.any():
                sensitivity[unknown] = 0.0
            moved = (-weights @ sensitivity).reshape(error.size, len(active))
            ends = columns + len(self.own)
            jacobian[: error.size, :columns] = moved[:, :columns]
            if slopes is not None:
                jacobian[: error.size, : columns + further] += moved[:, ends:] @ slopes
            jacobian[: error.size, columns + further :] = moved[:, columns:ends]
            jacobian[error.size :, :columns] = by[:, :columns] / spread[:, None]
            jacobian[error.size :, columns + further :] = by[:, columns:ends] / spread[:, None]
            blocks.append(Block(residual, jacobian[:, : columns + further], jacobian[:, columns + further :]))
        return blocks


def problem(
    model: Model | str,
    recordings: Sequence[Recording],
    *,
    estimate: Iterable[str] | None = None,
    support: float | None = None,
    longest: float | None = None,
    rows: Sequence[Segment] | None = None,
    progress: Progress | None = None,
) -> Problem:
    """The problem of fitting `model` to `recordings`; `estimate` names the estimated parameters, by default those that
    the model marks.

    `rows` are existing segments, made for another model with the same inputs and outputs; `recordings` are then not
    used.

    Raises DataError if the data cannot be used, ModelError for an unknown name, EstimationError if no parameter is to
    be estimated.
    """
    if isinstance(model, str):
        model = library.get(model)
    model = model.change(estimated=estimate) if estimate is not None else model
    free = tuple(place for place, parameter in enumerate(model.parameters) if parameter.estimated)
    shaken = parameters_of(model.base_states)
    if not any(model.parameters[place].name not in shaken for place in free):
        raise EstimationError(f"model {model.name}", "no parameter is to be estimated", remedy="name at least one.")
    for place in free:
        parameter = model.parameters[place]
        if not parameter.lower < parameter.upper:
            what = f"its bounds cross: {parameter.lower:g} and {parameter.upper:g}"
            raise EstimationError(f"parameter {parameter.name}", what, remedy="correct them in the model.")
        if not parameter.lower <= parameter.value <= parameter.upper:
            what = f"{parameter.value:g} {parameter.unit} is outside {parameter.lower:g} to {parameter.upper:g}"
            raise EstimationError(f"parameter {parameter.name}", what, remedy="start inside the bounds.")
    data = list(rows) if rows is not None else segments(model, recordings, support=support, longest=longest)
    kernel = compile_model(model, progress=progress)
    initials = tuple(initial_state(model, segment) for segment in data)
    own = tuple(place for place, state in enumerate(model.states) if state.initial_std > 0.0)
    spread = np.array([model.states[place].initial_std for place in own])
    substeps = _substeps(model, kernel, kernel.vector(), data)
    return Problem(model, kernel, tuple(data), free, own, initials, substeps, spread)


def _substeps(model: Model, kernel: Kernel, values: Array, data: Sequence[Segment]) -> int:
    """Steps per sample that the fastest pole requires at parameter values (np,), at rest and in motion."""
    return substeps_of(kernel, values, data, typical_motion(model, data))


def substeps_of(kernel: Kernel, values: Array, data: Sequence[Segment], motion: Array) -> int:
    """Steps per sample that the fastest pole requires at parameter values (np,), at rest and in the state `motion`
    (nx,)."""
    matrices = np.array([jacobian(kernel, values, data, state) for state in (None, motion)])
    return steps_within(float(np.median(np.diff(data[0].time))), matrices)


def steps_within(period: float, matrices: Array) -> int:
    """Number of Runge-Kutta steps within `period` s that the poles of continuous system matrices (..., nx, nx), 1/s,
    require: 1 to MOST."""
    poles = np.linalg.eigvals(matrices)
    steps = period * max(float(np.abs(poles.imag).max()) / STEP, float(np.abs(poles.real).max()) / DECAY)
    return int(np.clip(np.ceil(steps), 1, MOST))


def initial_state(model: Model, segment: Segment) -> Array:
    """The measured state at the first sample."""
    first = np.array([column[np.isfinite(column)][0] for column in segment.measured.T])
    known: Mapping[str, float] = {
        **model.values,
        **{each.name: float(value) for each, value in zip(model.outputs, first, strict=True)},
    }
    return np.array([number(state.initial, known, f"state {state.name}, initial") for state in model.states])


def jacobian(kernel: Kernel, values: Array, data: Sequence[Segment], motion: Array | None = None) -> Array:
    """The continuous system matrix (nx, nx) at the middle of the data, at rest or in the state `motion` (nx,)."""
    short = SHORT * float(np.median(np.diff(data[0].time)))
    transition, _ = linearise(kernel, values[None], at_rest(kernel, data, short), motion)
    return np.asarray((transition[0] - np.eye(len(kernel.states))) / short)


def at_rest(kernel: Kernel, data: Sequence[Segment], spacing: float) -> Segment:
    """Two samples `spacing` s apart with each input at its mean."""
    time = float(data[0].time[0]) + spacing * np.arange(2.0)
    held = np.repeat(data[0].inputs.mean(axis=0)[None, :], 2, axis=0)
    knots = np.repeat((time - 1.0)[:, None], len(kernel.inputs), axis=1)
    return Segment(time, np.ascontiguousarray(knots), held, np.full((2, len(kernel.outputs)), np.nan))


def typical_motion(model: Model, data: Sequence[Segment]) -> Array:
    """A state (nx,) in which the joints move at their RMS rate in `data`, with all other states zero.

    At rest, dry friction damps a model more than at any other state.
    """
    states = [each.name for each in model.states]
    motion = np.zeros(len(states))
    for joint in model.joints:
        if joint.rate not in states:
            continue
        rates, angles = (shown_by(model, text) for text in (joint.rate, joint.coordinate))
        if rates is not None:
            motion[states.index(joint.rate)] = np.sqrt(
                np.nanmean(np.concatenate([segment.measured[:, rates] for segment in data]) ** 2)
            )
        elif angles is not None:
            motion[states.index(joint.rate)] = _usual_rate(data, angles)
    return motion


def usual_motion(model: Model) -> Array:
    """The same from the scales of the model, for use before there are measurements."""
    rates = {joint.rate: joint.rate_scale for joint in model.joints}
    return np.array([rates.get(state.name, 0.0) for state in model.states])


def shown_by(model: Model, text: str) -> int | None:
    """Index of the output that equals the state or expression `text`; None if there is none."""
    outputs = [place for place, each in enumerate(model.outputs) if text in (each.name, each.expression)]
    return outputs[0] if outputs else None


def _usual_rate(data: Sequence[Segment], place: int) -> float:
    """RMS of the rate of the output at `place`, unit/s, without the contribution of its white noise to differences."""
    angles = [segment.measured[:, place] for segment in data]
    rates = np.concatenate([np.gradient(each, segment.time) for each, segment in zip(angles, data, strict=True)])
    noise = white_variance([each[:, None] for each in angles if len(each) > 4])[0][0]
    spacing = float(np.median(np.diff(data[0].time)))
    power = float(np.nanmean(rates**2))
    return float(np.sqrt(max(power - 0.5 * noise / spacing**2, SLOWEST**2 * power)))


def linearise(
    kernel: Kernel, values: Array, rest: Segment, state: Array | None = None, *, substeps: int = 1
) -> tuple[Array, Array]:
    """Transition matrices (m, nx, nx) between the two samples of `rest` and output matrices (m, ny, nx) at `state`
    (nx,), by default zero, for each row of parameter values (m, np).

    For a linear model they do not depend on the state.
    """
    states, outputs = len(kernel.states), len(kernel.outputs)
    begin = np.zeros(states) if state is None else state
    active = range(len(kernel.parameters), len(kernel.parameters) + states)
    memory, here = kernel.memory(begin, active), np.empty(values.shape[1])
    predicted, sensitivity = np.empty((2, outputs)), np.empty((2, outputs, states))
    move = kernel.ready(rest, here, memory, None, active, predicted, sensitivity, substeps=substeps)
    transition, output = np.empty((len(values), states, states)), np.empty((len(values), outputs, states))
    for place, row in enumerate(values):
        here[:], memory.x[:], memory.S[:] = row, begin, np.eye(states)
        move(0, 1, False)
        transition[place], output[place] = memory.S, sensitivity[0]
    return transition, output
