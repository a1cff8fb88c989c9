"""The fit of a model with its noise: the parameters under which each sample is best predicted from all before it.

Kalman innovations with the gain of the estimated noise, weighted by their covariance: maximum likelihood for Gaussian
noise, in open and in closed loop, on stable and on unstable plants. CAD values with their standard deviations are the
prior (maximum a posteriori), which a record of half a minute outweighs a thousand times. Several recordings are one
fit, each stretch with an initial state of its own. Source: Ljung, "System identification", 2nd ed., chapters 7 and 9.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from estimators.fit.gauss_newton import Minimum, common_information, descend
from estimators.fit.innovations import NoiseModel
from estimators.fit.likelihood import Likelihood, Seen
from estimators.fit.logarithms import InLogarithms
from estimators.fit.problem import Problem
from estimators.fit.result import inverse

Array = NDArray[np.float64]

SETTLING = 3
"""Steps of the initial states alone, where a fit begins at values that were fitted to other rows."""
ITERATIONS = 200
"""Steps at most. A robot of which seven numbers do much the same takes up to 102 (60 fits of 30 records)."""
ENOUGH = 1e-3
"""Fall of the log likelihood that is not worth a further step: no parameter moves by a twentieth of its deviation."""
MUCH = 3.0
"""Natural logarithm by which a noise is more, or less, than the model says, to begin with."""


@dataclass(frozen=True, slots=True)
class Step:
    """What a step of the fit came to: the cost, and the parameters with the logarithms of the noise, (p + q,)."""

    cost: float
    common: Array


@dataclass(frozen=True, slots=True)
class Begin:
    """Where a fit begins other than at what was known before: `values` by parameter, others at the model's; `noise`
    (q,), the logarithms of it that are estimated. From far off, the first steps of the others would drive a frequency
    or an instant into a minimum beside its own."""

    values: Mapping[str, float]
    noise: Array


@dataclass(frozen=True, slots=True)
class Fit:
    """A fitted predictor. `minimum.common` are the parameters, then the logarithms of the noise.

    `gain` (nx, ny); `covariance` (ny, ny) of the innovations; `prior` (p + q,) what the prior informs; `steps` by which
    the cost fell, the start first.
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
        """Where a fit of more data, of less, or with more parameters may begin."""
        names = [parameter.name for parameter in self.problem.parameters]
        values = dict(zip(names, self.minimum.common.tolist(), strict=False))
        return Begin(values, self.minimum.common[len(names) :])

    @property
    def starts(self) -> list[Array]:
        """The fitted initial state of each stretch, (nx,)."""
        starts = []
        for initial, part in zip(self.problem.initials, self.minimum.own, strict=False):
            start = initial.copy()
            start[list(self.problem.own)] = part
            starts.append(start)
        return starts

    def information(self, held: tuple[int, ...]) -> Array:
        """What the data tell (k, k) of what was estimated and of the parameters at `held`, without the prior.

        Raises ArithmeticError where the model runs away from its own estimate.
        """
        minimum = self.minimum
        likelihood = Likelihood(self.problem, NoiseModel.of(self.problem), minimum.common, self.prior)
        seen = likelihood.of_data(minimum.common, minimum.own, also=held)
        if seen is None:
            raise ArithmeticError("the model runs away from its own estimate")
        return common_information(seen.normals, len(minimum.common) + len(held))

    def joint_covariance(self) -> tuple[tuple[int, ...], Array]:
        """Places of the estimated and of the held parameters that are not exact, and the covariance of both (k, k)."""
        task, unknown = self.problem, len(self.minimum.common)
        size, held = len(task.free), task.uncertain
        if not held:
            return task.free, inverse(self.minimum.information)[:size, :size]
        # All of one evaluation: what takes the place of a held parameter cancels in a combination to the last digits.
        information = self.information(held)
        alone = inverse(information[:unknown, :unknown] + np.diag(self.prior))
        deviations = np.array([task.model.parameters[place].std for place in held])
        moves = np.concatenate((-(alone @ information[:unknown, unknown:])[:size], np.eye(len(held)))) * deviations
        covariance = moves @ moves.T
        covariance[:size, :size] += alone[:size, :size]
        return (*task.free, *held), covariance

    def innovations(self) -> list[Array]:
        """By stretch, (n, ny)."""
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
) -> Fit:
    """Parameters and noise from the model's values on, or from `begin`, in so many steps at most.

    Noise and initial states begin as in the fit `near`, of the same data, where there is one. White process noise and a
    disturbance take each other's place: what is missing may first go into the one that is less likely in the end. So
    where there is nothing else to begin from, the noise also begins with much of the latter and little of the former,
    and the likelier end stays.
    Raises ArithmeticError where even these values run away.
    """
    starts = [begin] if begin is not None or near is not None else _starts(task)
    found: list[Fit] = []
    for place, start in enumerate(starts):
        try:
            found.append(_fit(task, prior, iterations, near, start))
        except ArithmeticError:
            if place == len(starts) - 1 and not found:
                raise
    return min(found, key=lambda each: each.minimum.cost)


def _starts(task: Problem) -> list[Begin | None]:
    """Of the noise: as the model has it, and with much of its disturbances and little white."""
    much = noise_of(task, shaken=MUCH, white=-MUCH)
    return [None, Begin({}, much)] if (much < 0.0).any() and (much > 0.0).any() else [None]


def noise_of(task: Problem, *, shaken: float = 0.0, white: float = 0.0) -> Array:
    """Logarithms (q,) of the noise as the model has it, but for those of its disturbances and of the white process
    noise."""
    noise, states = NoiseModel.of(task), task.model.states
    logarithms = np.zeros(noise.size)
    for place, number in zip(noise.noisy, noise.process_place, strict=True):
        logarithms[number] = shaken if states[place].correlation_time else white
    return logarithms


def _fit(task: Problem, prior: bool, iterations: int, near: Fit | None, begin: Begin | None) -> Fit:
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
        told = [begin.values.get(parameter.name, parameter.value) for parameter in task.parameters]
        common = np.concatenate((told, begin.noise))
    steps: list[Step] = []
    while True:
        inside = InLogarithms.of(likelihood)

        def expand(common: Array, own: Sequence[Array], inside: InLogarithms = inside) -> Seen | None:
            seen = inside(common, own)
            if seen is not None and (not steps or seen.cost < steps[-1].cost):
                steps.append(Step(seen.cost, inside.natural(common)))
            return seen

        if begin is not None and near is None and not steps:
            own = _settled(expand, inside.inside(common), own)
        found = descend(
            expand,
            inside.inside(common),
            [*own, np.zeros(0)],
            scale=inside.scale(np.concatenate((task.scale, noises))),
            lower=inside.inside(lower),
            upper=inside.inside(upper),
            iterations=iterations,
            tolerance=1e-6,
            enough=ENOUGH,
            watched=size,
        )
        if found is None:
            raise ArithmeticError("the model runs away from its start values even with the measurement's help")
        minimum, there = inside.minimum(found[0], lower, upper), found[1]
        common, own = minimum.common, list(minimum.own[:-1])
        finer = task.refined(common[:size])
        if finer.substeps == task.substeps:
            gain = likelihood.noise.gain(task.values(common[:size]), common[size:])
            gain = there.gain if gain is None else gain
            spread = likelihood.long_run(task.values(common[:size]), common[size:]).spread
            return Fit(replace(task, spread=spread), minimum, gain, there.covariance, likelihood.prior, tuple(steps))
        task = finer
        likelihood = replace(likelihood, task=task)


def _settled(
    expand: Callable[[Array, Sequence[Array]], Seen | None], common: Array, own: Sequence[Array]
) -> list[Array]:
    """Initial states that suit the values `common`, which are held."""
    found = descend(
        expand,
        common,
        [*own, np.zeros(0)],
        scale=np.ones(len(common)),
        lower=common,
        upper=common,
        iterations=SETTLING,
        tolerance=1e-6,
        enough=ENOUGH,
    )
    return list(found[0].own[:-1]) if found else list(own)
