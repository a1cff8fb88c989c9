"""What a correct model would leave on a record: the innovations that noise alone makes, and their covariance.

    innovation_ratio = mean e' S^-1 e / ny,   S = C P C' + R

R is the sensors' noise as it shows in the record itself, Q the process noise that the model states, or less if the
record shows less (diagnosis.lack_of_fit.process_noise); P and the gain follow from the Riccati equation
(estimators.fit.innovations). The ratio, the normalised innovation squared, is about 1 if the model is correct, and
large if something is missing. Fourth differences of a white signal have 70 times its variance, while motion below a
tenth of the sampling rate all but vanishes in them; so the record's noise is separated from its motion without any
model. If a vehicle moves faster than that, the innovations of a predictor contain less of its motion, and never less
than the noise.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from upright.diagnosis.lack_of_fit.process_noise import density, shown_shares
from upright.diagnosis.lack_of_fit.reach import power_beyond, reach
from upright.estimators.contract import EstimationError
from upright.estimators.data.white_noise import white_variance
from upright.estimators.fit.gauss_newton import Block, minimise
from upright.estimators.fit.innovations import NoiseModel
from upright.estimators.fit.maximum_likelihood import Fit
from upright.estimators.fit.problem import Problem
from upright.estimators.fit.random.disturbance import stated
from upright.estimators.fit.stationary import stationary
from upright.estimators.tails import chi2_isf
from upright.models.parts import State
from upright.models.random.disturbance import parameters_of

Array = NDArray[np.float64]

OFFSET = "_offset"
"""Suffix of the name of a parameter that is a property of the timing of a record, not of the vehicle."""
OWN_NOISE = 1e-3
"""p-value of the scatter under a quantiser's noise alone, below which the sensor has noise of its own."""
QUIETEST = 1e-2
"""Least share of the stated noise that is assumed for a sensor: simulated data may have none."""


@dataclass(frozen=True, slots=True)
class Floor:
    """The innovations of a correct model on a record: covariance (ny, ny), rad^2 or the squares of the outputs' units.

    `gain` (nx, ny) is that of the predictor x+ = f(x + gain e). `transition` A (nx, nx) over `spacing` s and `output` C
    (ny, nx) are the linearised model; `process` (nx, nx) and `sensor` (ny, ny) the noise per sample; `state_covariance`
    (nx, nx) that of the state's error before the sample's own correction. `freedom` (ny,): degrees of freedom with
    which a sensor's noise is known, inf if the model states it as known. `process_shares` (nx,): share of the variance
    of the stated process noises that the record shows. `reach` (ny,): Hz up to which a force shows in an output.
    """

    gain: Array
    covariance: Array
    transition: Array
    output: Array
    process: Array
    sensor: Array
    state_covariance: Array
    freedom: Array
    spacing: float
    process_shares: Array
    reach: Array

    @property
    def predictor(self) -> Array:
        """Transition of an error of the state, A - A K C, (nx, nx): stable even if the plant is not."""
        return self.transition - self.transition @ self.gain @ self.output

    @property
    def whitener(self) -> Array:
        """The matrix that makes innovations independent and of unit variance, (ny, ny)."""
        return np.asarray(np.linalg.inv(np.linalg.cholesky(self.covariance)))

    @property
    def std(self) -> Array:
        """Standard deviation of the innovations by output, (ny,)."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def informative(self) -> list[int]:
        """Outputs whose noise is estimated from the record. A known noise is stated too large: no test builds on it."""
        measured = np.flatnonzero(np.isfinite(self.freedom)).tolist()
        return measured or list(range(len(self.freedom)))


@dataclass(frozen=True, slots=True)
class Innovations:
    """A model's one-step errors on a record: `errors` (n, ny) by segment. `fit` has values, initial states and gain."""

    fit: Fit
    floor: Floor
    errors: tuple[Array, ...]

    @property
    def problem(self) -> Problem:
        return self.fit.problem

    def blocks(self, also: Sequence[int] = ()) -> list[Block]:
        """Whitened errors by segment, and their derivatives with respect to the nuisances, the parameters at the places
        `also`, and the initial state; the last rows of a block are the prior of its initial state."""
        task, common = self.problem, self.fit.minimum.common
        blocks = task.evaluate(
            common, self.fit.minimum.own[:-1], weights=self.floor.whitener, gain=self.floor.gain, also=also
        )
        if blocks is None:
            raise ArithmeticError("the model diverges at its own estimate")
        return blocks

    @property
    def normalised(self) -> list[Array]:
        """By segment, each output over the standard deviation of its floor, (n, ny); unknown samples are 0."""
        return [np.nan_to_num(part / self.floor.std) for part in self.errors]

    @property
    def ratio(self) -> float:
        """mean e' S^-1 e / ny over the outputs that are informative."""
        chosen = self.floor.informative
        weights = np.linalg.inv(np.linalg.cholesky(self.floor.covariance[np.ix_(chosen, chosen)]))
        white = np.concatenate([part[:, chosen] @ weights.T for part in self.errors])
        return float(np.nanmean(white**2))


def at(task: Problem, values: Array, free: tuple[int, ...] = ()) -> Problem:
    """`task` at parameter values (np,), with the parameters at the places `free` estimated instead of its own."""
    moved = replace(task, kernel=replace(task.kernel, defaults=np.array(values, dtype=np.float64)), free=free)
    return moved.refined(moved.kernel.defaults[list(free)])


@dataclass(frozen=True, slots=True)
class Left:
    """What a predictor left: `errors`, innovations by segment (n, ny), and `beyond` (ny,), the variance of a sensor's
    white noise that explains the frequencies at which no force shows (diagnosis.lack_of_fit.reach), estimated from so
    many spectral `lines` (ny,)."""

    errors: Sequence[Array]
    beyond: Array
    lines: Array


def sensor_noise(task: Problem, left: Left | None = None) -> tuple[Array, Array]:
    """Standard deviation of each output's white noise, (ny,), and the degrees of freedom with which it is known, (ny,).

    The noise is taken from the innovations that were `left` if they have less of it than the record, and from the
    frequencies at which no force shows if these have more."""
    outputs = task.model.outputs
    stated = np.array([output.noise for output in outputs])
    variance, rows = white_variance([segment.measured for segment in task.segments])
    freedom = np.full(len(variance), rows)
    if left is not None:
        variance = np.asarray(np.minimum(variance, white_variance(left.errors)[0]))
        freedom = np.where(left.beyond > variance, left.lines, freedom)
        variance = np.asarray(np.maximum(variance, left.beyond))
    # A counted output has at least a quantiser's noise, and noise of its own if there is significantly more.
    counts = np.array([output.counted and not output.noise_known for output in outputs])
    more = freedom * variance > chi2_isf(OWN_NOISE, freedom) * stated**2
    known = np.array([output.noise_known for output in outputs]) | (counts & ~more)
    found = np.maximum(np.sqrt(variance), QUIETEST * stated)
    return np.where(known, stated, found), np.where(known, np.inf, freedom)


def floor(task: Problem, values: Array) -> Floor:
    """The innovations that a correct model would leave on the record of `task`, at parameter values (np,).

    Raises EstimationError if no predictor with these values is stable, or if the model diverges from the record.
    """
    return _lowered(_fitted(at(task, values), _floor(task, values, np.ones(len(task.kernel.states)))))


def _lowered(found: Innovations) -> Floor:
    """The floor with no more process noise than the innovations show."""
    task, values = found.problem, found.fit.values
    noise, left = NoiseModel.of(task), _left(found)
    every = np.eye(len(noise.process))[list(noise.noisy)]
    systems = [
        _noise(task, share, left).covariances(values, np.zeros(noise.size))
        for share in (np.zeros(len(noise.process)), *every)
    ]
    shares = shown_shares(found.errors, found.floor.gain, systems[0], systems[1:], found.floor.informative)
    return _floor(task, values, shares @ every, left)


def _left(found: Innovations) -> Left:
    least = found.floor
    nothing = np.zeros_like(least.process)
    system = (least.transition, least.output, nothing, least.sensor, np.zeros((len(nothing), len(least.sensor))))

    def expected(turns: Array) -> Array:
        return np.asarray(np.einsum("fyy->fy", density(turns, least.gain, system)).real)

    over, lines = power_beyond(found.errors, least.spacing, least.reach, expected)
    return Left(found.errors, over * np.diag(least.sensor), lines)


def _noise(task: Problem, shares: Array, left: Left | None = None) -> NoiseModel:
    """The noise model with sensor noise from the record and shares (nx,) of the variances of unknown process noise."""
    noise = NoiseModel.of(task)
    known = np.ones(len(shares))
    known[list(noise.noisy)] = shares[list(noise.noisy)]
    return replace(noise, sensor=sensor_noise(task, left)[0], process=noise.process * np.sqrt(known))


def _floor(task: Problem, values: Array, shares: Array, left: Left | None = None) -> Floor:
    noise = _noise(task, shares, left)
    freedom = sensor_noise(task, left)[1]
    gain = noise.gain(values, np.zeros(noise.size))
    if gain is None:
        what = "has no stable predictor at these parameter values"
        raise EstimationError(f"model {task.model.name}", what, remedy="check the values and the noises it states.")
    transition, output, process, shown, across = noise.covariances(values, np.zeros(noise.size))
    ahead = transition @ gain
    closed = transition - ahead @ output
    driven = process + ahead @ shown @ ahead.T - across @ ahead.T - ahead @ across.T
    state = stationary(closed, driven)
    return Floor(
        gain=gain,
        covariance=output @ state @ output.T + shown,
        transition=transition,
        output=output,
        process=process,
        sensor=shown,
        state_covariance=state,
        freedom=freedom,
        spacing=noise.spacing,
        process_shares=shares,
        reach=reach(task, values, noise.sensor),
    )


def shaken_as(task: Problem, values: Array, of: Fit) -> tuple[Problem, Array]:
    """`task` and parameter values (np,) with the disturbances that the fit `of` estimated.

    The disturbance is what the best hypothesis leaves: the vehicle is not shaken more under another model of the same
    record, whatever disturbance that model's own fit needed.
    """
    known = {state.name: float(spread) for state, spread in _starts(of.problem) if state.correlation_time}
    spread = np.array([known.get(state.name, float(each)) for state, each in _starts(task)])
    values = values.copy()
    for name in parameters_of(of.problem.model.base_states).intersection(task.kernel.parameters):
        values[task.kernel.index(name)] = of.values[of.problem.kernel.index(name)]
    return replace(task, model=stated(task.model, of), spread=spread), values


def _starts(task: Problem) -> list[tuple[State, float]]:
    """The states whose initial value is fitted, and the standard deviation of its prior."""
    return list(zip([task.model.states[place] for place in task.own], task.spread.tolist(), strict=True))


def innovations(task: Problem, values: Array, floor: Floor) -> Innovations:
    """The one-step errors at parameter values (np,), with the initial state of each segment fitted.

    Raises EstimationError if the model diverges.
    """
    return _fitted(at(task, values), floor)


def nuisances(task: Problem) -> tuple[int, ...]:
    """The places of the parameters that are not properties of the vehicle: the time offsets of the inputs, which delay
    an input and are called `..._offset`, and the events of the run (`Effect.of_run`)."""
    offsets = [name for each in task.model.inputs for name in each.delays if name.endswith(OFFSET)]
    events = [each.name for effect in task.model.effects if effect.effect.of_run for each in effect.parameters]
    return tuple(dict.fromkeys(map(task.kernel.index, (*offsets, *events))))


def with_nuisances(task: Problem, values: Array) -> Innovations:
    """The same with the nuisances of the run fitted, too; their standard deviations are the prior."""
    chosen = nuisances(task)
    stated = _fitted(at(task, values, chosen), _floor(task, values, np.ones(len(task.kernel.states))))
    return _fitted(stated.problem, _lowered(stated))


def _fitted(task: Problem, floor: Floor) -> Innovations:
    centre, weights = task.start, floor.whitener
    start = task.kernel.defaults[list(task.free)]
    deviations = np.array([parameter.std for parameter in task.parameters])
    tight = np.where(deviations > 0.0, 1.0 / np.where(deviations > 0.0, deviations, 1.0), 0.0)

    def evaluate(common: Array, own: Sequence[Array]) -> list[Block] | None:
        blocks = task.evaluate(common, own[:-1], weights=weights, gain=floor.gain)
        if blocks is None:
            return None
        return [*blocks, Block((common - centre) * tight, np.diag(tight), np.zeros((len(tight), 0)))]

    lower, upper = task.bounds
    found = minimise(evaluate, start, [*task.own_start, np.zeros(0)], scale=task.scale, lower=lower, upper=upper)
    if found is None:
        what = "diverges from the record even when the measurement corrects it"
        raise EstimationError(f"model {task.model.name}", what, remedy="check its parameter values and signs.")
    fit = Fit(task, found, floor.gain, floor.covariance, tight**2)
    return Innovations(fit, floor, tuple(fit.innovations()))


def innovation_ratio(task: Problem, values: Array, floor: Floor) -> float:
    """mean e' S^-1 e / ny at parameter values (np,), initial states fitted: about 1 for a correct model."""
    return innovations(task, values, floor).ratio
