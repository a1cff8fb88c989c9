"""What a right model would leave over on a record: the innovations that the noise alone makes, and their covariance.

    innovation_ratio = mean e' S^-1 e / ny,   S = C P C' + R

R is the sensors' noise as it shows in the record itself, Q the process noise that the model states, or less where the
record shows less (diagnosis.lack_of_fit.process_noise), P and the gain from the Riccati equation
(estimators.fit.innovations). The ratio is about 1 where the model is right, and large where something is missing.
Fourth differences of a white signal have 70 times its variance, while motion below a tenth of the sampling rate all but
vanishes in them; so the record's noise is told apart from its motion without any model. Where a vehicle moves faster
than that, what a predictor leaves has less: no predictor leaves less than the noise.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from diagnosis.lack_of_fit.process_noise import density, shown_shares
from diagnosis.lack_of_fit.reach import power_beyond, reach
from estimators.contract import EstimationError
from estimators.data.white_noise import white_variance
from estimators.fit.disturbance import stated
from estimators.fit.gauss_newton import Block, minimise
from estimators.fit.innovations import NoiseModel
from estimators.fit.maximum_likelihood import Fit
from estimators.fit.problem import Problem
from estimators.fit.stationary import stationary
from models.parts import State
from models.random.disturbance import parameters_of

Array = NDArray[np.float64]

OFFSET = "_offset"
"""How the name of a parameter ends that is no property of a vehicle, but of the instants of its record."""
SURELY = 1e-3
"""Probability with which a quantiser alone would scatter so much as is taken for a sensor's own noise beside it."""
QUIETEST = 1e-2
"""Share of the noise that the model states below which no sensor is believed: simulated data may have none."""


@dataclass(frozen=True, slots=True)
class Floor:
    """What a right model's innovations are on a record: covariance (ny, ny), rad^2 or what the outputs' units say.

    `gain` (nx, ny) is that of the predictor x+ = f(x + gain e). `transition` A (nx, nx) over `spacing` s and `output` C
    (ny, nx) are the linearised model; `process` (nx, nx) and `sensor` (ny, ny) the noise of a row; `state_covariance`
    (nx, nx) that of the state's error before the row's own correction. `freedom` (ny,): degrees of freedom with which
    a sensor's noise is known, inf where the model knows it. `process_shares` (nx,): how much of the
    variance of the stated process noises the record shows. `reach` (ny,): Hz up to which a force shows in an output.
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
        """How an error of the state goes on, A - A K C, (nx, nx): stable, also where the plant is not."""
        return self.transition - self.transition @ self.gain @ self.output

    @property
    def whitener(self) -> Array:
        """What makes innovations independent and of unit variance, (ny, ny)."""
        return np.asarray(np.linalg.inv(np.linalg.cholesky(self.covariance)))

    @property
    def std(self) -> Array:
        """Of the innovations by output, (ny,)."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def informative(self) -> list[int]:
        """Outputs whose noise is measured. One that is known is stated too large, so that nothing builds on it."""
        measured = np.flatnonzero(np.isfinite(self.freedom)).tolist()
        return measured or list(range(len(self.freedom)))


@dataclass(frozen=True, slots=True)
class Innovations:
    """A model's one-step errors on a record: by stretch `errors` (n, ny). `fit` holds values, starts and the gain."""

    fit: Fit
    floor: Floor
    errors: tuple[Array, ...]

    @property
    def problem(self) -> Problem:
        return self.fit.problem

    def blocks(self, also: Sequence[int] = ()) -> list[Block]:
        """Whitened errors by stretch, and their derivatives: by the nuisances, by the parameters at the places `also`,
        by the start; what is known of the start is its last rows."""
        task, common = self.problem, self.fit.minimum.common
        blocks = task.evaluate(
            common, self.fit.minimum.own[:-1], weights=self.floor.whitener, gain=self.floor.gain, also=also
        )
        if blocks is None:
            raise ArithmeticError("the model runs away from its own estimate")
        return blocks

    @property
    def normalised(self) -> list[Array]:
        """By stretch, each output over the standard deviation of its floor, (n, ny); unknown ones are 0."""
        return [np.nan_to_num(part / self.floor.std) for part in self.errors]

    @property
    def ratio(self) -> float:
        """mean e' S^-1 e / ny over the outputs that are informative."""
        chosen = self.floor.informative
        weights = np.linalg.inv(np.linalg.cholesky(self.floor.covariance[np.ix_(chosen, chosen)]))
        white = np.concatenate([part[:, chosen] @ weights.T for part in self.errors])
        return float(np.nanmean(white**2))


def at(task: Problem, values: Array, free: tuple[int, ...] = ()) -> Problem:
    """`task` about parameter values (np,), asked for the parameters at the places `free` instead of its own."""
    moved = replace(task, kernel=replace(task.kernel, defaults=np.array(values, dtype=np.float64)), free=free)
    return moved.refined(moved.kernel.defaults[list(free)])


@dataclass(frozen=True, slots=True)
class Left:
    """What a predictor left: `errors`, innovations by stretch (n, ny), and of what no force shows in
    (diagnosis.lack_of_fit.reach) the variance that a sensor's white noise would have for it, `beyond` (ny,), told by so
    many `lines` (ny,)."""

    errors: Sequence[Array]
    beyond: Array
    lines: Array


def sensor_noise(task: Problem, left: Left | None = None) -> tuple[Array, Array]:
    """Standard deviation of each output's white noise, (ny,), and the degrees of freedom it is known with, (ny,).

    Of what was `left` the noise is taken where there is less of it than in the record, and where there is more of it
    than this at frequencies that are its own."""
    outputs = task.model.outputs
    stated = np.array([output.noise for output in outputs])
    variance, rows = white_variance([segment.measured for segment in task.segments])
    freedom = np.full(len(variance), rows)
    if left is not None:
        variance = np.asarray(np.minimum(variance, white_variance(left.errors)[0]))
        freedom = np.where(left.beyond > variance, left.lines, freedom)
        variance = np.asarray(np.maximum(variance, left.beyond))
    # What is counted has a quantiser's noise at least, and its own beside that where there is surely more.
    counts = np.array([output.counted and not output.noise_known for output in outputs])
    more = freedom * variance > chi2.isf(SURELY, freedom) * stated**2
    known = np.array([output.noise_known for output in outputs]) | (counts & ~more)
    found = np.maximum(np.sqrt(variance), QUIETEST * stated)
    return np.where(known, stated, found), np.where(known, np.inf, freedom)


def floor(task: Problem, values: Array) -> Floor:
    """The innovations that a right model would leave on the record of `task`, at parameter values (np,).

    Raises EstimationError where no predictor with these values is stable, or the model runs away from the record.
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
    """The noise with the sensors' from the record, and shares (nx,) of the variance of process noise not known."""
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
    """`task` and parameter values (np,) with the disturbances that the fit `of` found as what they are.

    A disturbance is what the best hypothesis leaves: another model of the same record is not shaken more, whatever its
    own fit had to take for one.
    """
    known = {state.name: float(spread) for state, spread in _starts(of.problem) if state.correlation_time}
    spread = np.array([known.get(state.name, float(each)) for state, each in _starts(task)])
    values = values.copy()
    for name in parameters_of(of.problem.model.base_states).intersection(task.kernel.parameters):
        values[task.kernel.index(name)] = of.values[of.problem.kernel.index(name)]
    return replace(task, model=stated(task.model, of), spread=spread), values


def _starts(task: Problem) -> list[tuple[State, float]]:
    """The states whose start is fitted, and how far off it may be."""
    return list(zip([task.model.states[place] for place in task.own], task.spread.tolist(), strict=True))


def innovations(task: Problem, values: Array, floor: Floor) -> Innovations:
    """The one-step errors at parameter values (np,), with the initial state of each stretch fitted.

    Raises EstimationError where the model runs away.
    """
    return _fitted(at(task, values), floor)


def with_nuisances(task: Problem, values: Array) -> Innovations:
    """The same with what is no property of the vehicle fitted along: the time offsets of the inputs.

    Parameters that delay an input and are called `..._offset` are meant; their standard deviations are the prior.
    """
    offsets = tuple(dict.fromkeys(
        task.kernel.index(name) for each in task.model.inputs for name in each.delays if name.endswith(OFFSET)
    ))  # fmt: skip
    stated = _fitted(at(task, values, offsets), _floor(task, values, np.ones(len(task.kernel.states))))
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
        what = "runs away from the record even with the measurement's help"
        raise EstimationError(f"model {task.model.name}", what, remedy="check its parameter values and signs.")
    fit = Fit(task, found, floor.gain, floor.covariance, tight**2)
    return Innovations(fit, floor, tuple(fit.innovations()))


def innovation_ratio(task: Problem, values: Array, floor: Floor) -> float:
    """mean e' S^-1 e / ny at parameter values (np,), initial states fitted: about 1 for a right model."""
    return innovations(task, values, floor).ratio
