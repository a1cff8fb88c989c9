"""The fit of a model with its noise by prediction error: each sample is predicted from all previous ones.

Kalman innovations with the gain of the estimated noise, weighted by their covariance: maximum likelihood for Gaussian
noise, in open and in closed loop, for stable and for unstable plants. CAD values with their standard deviations are the
prior (maximum a posteriori), which a record of half a minute outweighs a thousand times. Several recordings are fitted
together, each segment with its own initial state. Source: Ljung, "System identification", 2nd ed., chapters 7 and 9.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from upright.estimators.fit.gauss_newton import Minimum, common_information, descend
from upright.estimators.fit.innovations import NoiseModel
from upright.estimators.fit.likelihood import Likelihood, Seen
from upright.estimators.fit.logarithms import InLogarithms
from upright.estimators.fit.problem import Problem
from upright.estimators.fit.result import inverse
from upright.estimators.fit.stationary_start import stationary_spread

Array = NDArray[np.float64]

SETTLING = 3
"""Steps of the initial states alone, if a fit begins at values that were fitted to other data."""
ITERATIONS = 200
"""Largest number of steps. A robot with seven highly correlated parameters takes up to 102 (60 fits of 30 records)."""
CREEPING = 1.0
"""Rise of the log-likelihood, in nats, that is too small to decide anything."""
ENOUGH = 1e-3
"""Rise of the log-likelihood below which no further step is made: no parameter would move by a twentieth of its
standard deviation."""
MUCH = 3.0
"""Natural logarithm by which a noise starts above, or below, the model's value."""


@dataclass(frozen=True, slots=True)
class Step:
    """The result of one step of a fit: the cost, and the parameters with the logarithms of the noise, (p + q,)."""

    cost: float
    common: Array


@dataclass(frozen=True, slots=True)
class Begin:
    """Start of a fit other than the prior: `values` by parameter (others start at the model's), and `noise` (q,), the
    estimated logarithms of the noise. From a distant start, the first steps of the other unknowns would drive a
    frequency or a change point into a neighbouring local minimum."""

    values: Mapping[str, float]
    noise: Array


@dataclass(frozen=True, slots=True)
class Fit:
    """A fitted predictor. `minimum.common` are the parameters, then the logarithms of the noise.

    `gain` (nx, ny); `covariance` (ny, ny) of the innovations; `prior` (p + q,) the information of the prior; `steps`
    that reduced the cost, the start first.
    """

    problem: Problem
    minimum: Minimum
    gain: Array
    covariance: Array
    prior: Array
    steps: tuple[Step, ...] = ()

    @property
    def values(self) -> Array:
        """All parameter values, (np,)."""
        return self.problem.values(self.minimum.common[: len(self.problem.free)])

    @property
    def end(self) -> Begin:
        """Start for a fit to more or fewer data, or with more parameters."""
        names = [parameter.name for parameter in self.problem.parameters]
        values = dict(zip(names, self.minimum.common.tolist(), strict=False))
        return Begin(values, self.minimum.common[len(names) :])

    @property
    def starts(self) -> list[Array]:
        """The fitted initial state of each segment, (nx,)."""
        return list(map(self.problem.begin, self.problem.initials, self.minimum.own))

    def information(self, held: tuple[int, ...]) -> Array:
        """Information (k, k) of the data on the estimated unknowns and on the parameters at `held`, without the prior.

        Raises ArithmeticError if the model diverges at its own estimate.
        """
        minimum = self.minimum
        likelihood = Likelihood(self.problem, NoiseModel.of(self.problem), minimum.common, self.prior)
        seen = likelihood.of_data(minimum.common, minimum.own, also=held)
        if seen is None:
            raise ArithmeticError("the model diverges at its own estimate")
        return common_information(seen.normals, len(minimum.common) + len(held))

    def joint_covariance(self) -> tuple[tuple[int, ...], Array]:
        """Indices of the estimated parameters and of the held ones that are not exact, and their covariance (k, k)."""
        task, unknown = self.problem, len(self.minimum.common)
        size, held = len(task.free), task.uncertain
        if not held:
            return task.free, inverse(self.minimum.information)[:size, :size]
        # All from one evaluation: what is confounded with a held parameter then cancels in a combination to the last
        # digits.
        information = self.information(held)
        alone = inverse(information[:unknown, :unknown] + np.diag(self.prior))
        deviations = np.array([task.model.parameters[place].std for place in held])
        moves = np.concatenate((-(alone @ information[:unknown, unknown:])[:size], np.eye(len(held)))) * deviations
        covariance = moves @ moves.T
        covariance[:size, :size] += alone[:size, :size]
        return (*task.free, *held), covariance

    def innovations(self) -> list[Array]:
        """Innovations by segment, (n, ny)."""
        task = self.problem
        return [
            segment.measured
            - task.kernel.run(segment, self.values, start, gain=self.gain, substeps=task.substeps).predicted
            for segment, start in zip(task.segments, self.starts, strict=True)
        ]


def fit(
    task: Problem,
    *,
    prior: bool = True,
    iterations: int = ITERATIONS,
    near: Fit | None = None,
    begin: Begin | None = None,
    enough: float = ENOUGH,
) -> Fit:
    """Fits parameters and noise, from the model's values or from `begin`, in at most `iterations` steps, until the cost
    is not expected to fall by more than `enough`.

    Noise and initial states start as in the fit `near` to the same data, if it is given. White process noise and a
    disturbance are confusable: the residual torque may first be attributed to the one that is finally less likely. So
    if neither `near` nor `begin` is given, a second fit starts with a large disturbance and little white noise. Both
    end where little more is expected, and only the likelier one is continued. Raises ArithmeticError if the model
    diverges at the start values.
    """
    starts = [begin] if begin is not None or near is not None else _starts(task)
    roughly = enough if len(starts) == 1 else max(enough, CREEPING)
    found: list[Fit] = []
    for place, start in enumerate(starts):
        try:
            found.append(_fit(task, prior, iterations, near, start, roughly))
        except ArithmeticError:
            if place == len(starts) - 1 and not found:
                raise
    best = min(found, key=lambda each: each.minimum.cost)
    if roughly == enough or not best.minimum.converged:
        return best
    ended = _fit(task, prior, iterations, best, best.end, enough)
    return replace(ended, steps=(*best.steps, *ended.steps))


def _starts(task: Problem) -> list[Begin | None]:
    """Starts of the noise: that of the model, and one with large disturbances and little white noise."""
    much = noise_of(task, shaken=MUCH, white=-MUCH)
    return [None, Begin({}, much)] if (much < 0.0).any() and (much > 0.0).any() else [None]


def noise_of(task: Problem, *, shaken: float = 0.0, white: float = 0.0) -> Array:
    """Logarithms (q,) of the noise: `shaken` for disturbances, `white` for white process noise, 0 for sensors."""
    noise, states = NoiseModel.of(task), task.model.states
    logarithms = np.zeros(noise.size)
    for place, number in zip(noise.noisy, noise.process_place, strict=True):
        logarithms[number] = shaken if states[place].correlation_time else white
    return logarithms


def _fit(task: Problem, prior: bool, iterations: int, near: Fit | None, begin: Begin | None, enough: float) -> Fit:
    size = len(task.free)
    likelihood = Likelihood.of(task, np.array([parameter.std if prior else 0.0 for parameter in task.parameters]))
    noises = np.ones(likelihood.noise.size)
    widest = likelihood.noise.widest
    lower, upper = (np.concatenate((each, sign * widest)) for each, sign in zip(task.bounds, (-1, 1), strict=True))
    common, own = likelihood.centre, task.own_start
    if near is not None:
        common = np.concatenate((task.start, near.minimum.common[len(near.problem.free) :]))
        own = list(near.minimum.own)[: len(own)]
    if begin is not None:
        values = [begin.values.get(parameter.name, parameter.value) for parameter in task.parameters]
        common = np.concatenate((values, begin.noise))
    steps: list[Step] = []
    while True:
        inside = InLogarithms.of(likelihood)

        def expand(common: Array, own: Sequence[Array], inside: InLogarithms = inside) -> Seen | None:
            seen = inside(common, own)
            if seen is not None and (not steps or seen.cost < steps[-1].cost):
                steps.append(Step(seen.cost, inside.natural(common)))
            return seen

        if begin is not None and near is None and not steps:
            own = _settled(likelihood, common, own)
        found = descend(
            expand,
            inside.inside(common),
            [*own, np.zeros(0)],
            scale=inside.scale(np.concatenate((task.scale, noises))),
            lower=inside.inside(lower),
            upper=inside.inside(upper),
            iterations=iterations,
            tolerance=1e-6,
            enough=enough,
            watched=size,
            is_finite=inside.is_finite,
        )
        if found is None:
            raise ArithmeticError("the model diverges at the start values although the filter corrects it")
        minimum, there = inside.minimum(found[0], lower, upper), found[1]
        common, own = minimum.common, list(minimum.own[:-1])
        finer = task.refined(common[:size])
        if finer.substeps == task.substeps:
            gain = likelihood.noise.gain(task.values(common[:size]), common[size:])
            gain = there.gain if gain is None else gain
            spread = stationary_spread(likelihood.noise, task.values(common[:size]), common[size:])
            return Fit(replace(task, spread=spread), minimum, gain, there.covariance, likelihood.prior, tuple(steps))
        task = finer
        likelihood = replace(likelihood, task=task)


def _settled(likelihood: Likelihood, common: Array, own: Sequence[Array]) -> list[Array]:
    """Initial states fitted at the values `common`, which are held."""
    noise = common[len(likelihood.task.free) :]
    found = descend(
        likelihood.held(common),
        noise,
        [*own, np.zeros(0)],
        scale=np.ones(len(noise)),
        lower=noise,
        upper=noise,
        iterations=SETTLING,
        tolerance=1e-6,
        enough=ENOUGH,
    )
    return list(found[0].own[:-1]) if found else list(own)
