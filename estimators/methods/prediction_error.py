"""Prediction error: the parameters under which each sample is best predicted from all samples before it.

Kalman innovations with the gain of the estimated noise, weighted by their covariance: maximum likelihood for Gaussian
noise, in open and in closed loop, on stable and on unstable plants. CAD values with their standard deviations are the
prior (maximum a posteriori), which a record of half a minute outweighs a thousand times. Several recordings are one
fit, each stretch with an initial state of its own. Source: Ljung, "System identification", 2nd ed., chapters 7 and 9.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from estimators.contract import Estimate
from estimators.fit_result import assemble, inverse, refused, with_known
from estimators.gauss_newton import Block, Minimum, eliminate, minimise
from estimators.innovations import SPREAD, WIDEST, NoiseModel
from estimators.problem import Problem, problem
from estimators.segments import DataError
from estimators.stopwatch import stopwatch
from models import library
from models.kernel import Progress
from models.model import Model
from telemetry.recording import Recording

Array = NDArray[np.float64]

METHOD = "prediction_error"
ROUNDS = 10
"""Times, at most, that parameters and the innovations' covariance are estimated in turn."""
ENOUGH = 1e-3
"""Fall of the log likelihood that is not worth a further step: no parameter moves by a twentieth of its deviation."""
FLOOR = 10.0
"""Times the known noise of a sensor below which its innovations are no information about the vehicle."""
HORIZON = 0.5
"""s ahead that fit_percent tells of."""


@dataclass(frozen=True, slots=True)
class Fit:
    """A fitted predictor. `minimum.common` are the parameters, then the logarithms of the noise.

    `gain` (nx, ny); `covariance` (ny, ny) of the innovations; `prior` (p + q,) what the prior informs.
    """

    problem: Problem
    minimum: Minimum
    gain: Array
    covariance: Array
    prior: Array

    @property
    def values(self) -> Array:
        """All parameter values, (np,)."""
        return self.problem.values(self.minimum.common[: len(self.problem.free)])

    @property
    def starts(self) -> list[Array]:
        """The fitted initial state of each stretch, (nx,)."""
        starts = []
        for initial, part in zip(self.problem.initials, self.minimum.own, strict=False):
            start = initial.copy()
            start[list(self.problem.own)] = part
            starts.append(start)
        return starts

    def innovations(self) -> list[Array]:
        """By stretch, (n, ny)."""
        task = self.problem
        return [
            segment.measured
            - task.kernel.run(segment, self.values, start, gain=self.gain, substeps=task.substeps).predicted
            for segment, start in zip(task.segments, self.starts, strict=True)
        ]


def prediction_error(
    model: Model | str,
    recordings: Sequence[Recording],
    *,
    estimate: Iterable[str] | None = None,
    support: float | None = None,
    prior: bool = True,
    progress: Progress | None = None,
) -> Estimate:
    """Fit `model` to `recordings`. `estimate` names the parameters sought, by default those the model says.

    `support` rad: the vehicle is free where its roll is less; `prior`: use the standard deviations of the model's
    parameters. Data that cannot be used give an Estimate without values that says why. Raises ModelError and
    EstimationError for a model or names that cannot be.
    """
    began = stopwatch()
    model = library.get(model) if isinstance(model, str) else model
    try:
        task = problem(model, recordings, estimate=estimate, support=support, progress=progress)
    except DataError as error:
        return refused(model, METHOD, error, stopwatch() - began)
    return result(fit(task, prior=prior), began)


def fit(task: Problem, *, prior: bool = True) -> Fit:
    """Parameters and noise from the model's values on. Raises ArithmeticError where even these run away."""
    noise = NoiseModel.of(task)
    size = len(task.free)
    centre = np.concatenate((task.start, np.zeros(noise.size)))
    scale = np.concatenate((task.scale, np.ones(noise.size)))
    deviations = np.array([parameter.std if prior else 0.0 for parameter in task.parameters])
    deviations = np.concatenate((deviations, np.full(noise.size, SPREAD)))
    weight = np.where(deviations > 0.0, 1.0 / np.where(deviations > 0.0, deviations, 1.0), 0.0)
    lower, upper = (np.concatenate((bound, np.full(noise.size, sign * WIDEST))) for bound, sign in _signed(task))
    common, own = centre, [*task.own_start, np.zeros(0)]
    covariance = np.diag(noise.sensor**2)
    minimum: Minimum | None = None
    for turn in range(ROUNDS):
        weights = np.linalg.inv(np.linalg.cholesky(covariance))

        def evaluate(
            common: Array, own: Sequence[Array], task: Problem = task, weights: Array = weights
        ) -> list[Block] | None:
            gain = noise.gain(task.values(common[:size]), common[size:])
            if gain is None:
                return None
            slopes = noise.slopes(task.values(common[:size]), common[size:], task.free, task.scale)
            if slopes is None:
                return None
            blocks = task.evaluate(common[:size], own[:-1], weights=weights, gain=gain, slopes=slopes)
            if blocks is None:
                return None
            return [*blocks, Block((common - centre) * weight, np.diag(weight), np.zeros((len(weight), 0)))]

        if turn == 0 and (first := evaluate(common, own)) is not None:
            covariance = _covariance(first[:-1], weights, task)
            continue
        minimum = minimise(
            evaluate,
            common,
            own,
            scale=scale,
            lower=lower,
            upper=upper,
            iterations=25,
            tolerance=1e-4,
            enough=ENOUGH,
            watched=size,
        )
        if minimum is None:
            raise ArithmeticError("the model runs away from its start values even with the measurement's help")
        settled = turn > 1 and np.max(np.abs(minimum.common[:size] - common[:size]) / task.scale) < 1e-3
        common, own = minimum.common, list(minimum.own)
        before, covariance = covariance, _covariance(minimum.blocks[:-1], weights, task)
        finer = task.refined(common[:size])
        if finer.substeps > task.substeps:
            task = finer
            continue
        if settled and np.allclose(np.diag(before), np.diag(covariance), rtol=0.01):
            minimum = replace(minimum, converged=True)
            break
    assert minimum is not None
    gain = noise.gain(task.values(common[:size]), common[size:])
    assert gain is not None
    return Fit(task, minimum, gain, covariance, weight**2)


def _signed(task: Problem) -> tuple[tuple[Array, float], tuple[Array, float]]:
    lower, upper = task.bounds
    return (lower, -1.0), (upper, 1.0)


def _covariance(blocks: Sequence[Block], weights: Array, task: Problem) -> Array:
    """The innovations' covariance (ny, ny) as it is in the data."""
    outputs = len(weights)
    rows = [len(segment) * outputs for segment in task.segments]
    white = np.concatenate(
        [block.residual[:count].reshape(-1, outputs) for block, count in zip(blocks, rows, strict=True)]
    )
    back = np.linalg.inv(weights)
    covariance = back @ (white.T @ white / len(white)) @ back.T
    shares = [FLOOR if output.noise_known else 1e-9 for output in task.model.outputs]
    floor = np.array([share * output.noise for share, output in zip(shares, task.model.outputs, strict=True)])
    return np.asarray(covariance + np.diag(np.square(floor)))


def result(fitted: Fit, began: float) -> Estimate:
    """The Estimate of a fit; the uncertainty of what was held is in its standard deviations."""
    task, minimum = fitted.problem, fitted.minimum
    size, held = len(task.free), task.uncertain
    noise = NoiseModel.of(task)
    values, logarithms = fitted.values, minimum.common[size:]
    places = (*task.free, *held)
    typical = np.array([task.model.parameters[place].typical for place in places])
    slopes = noise.slopes(values, logarithms, places, typical)
    weights = np.linalg.inv(np.linalg.cholesky(fitted.covariance))
    blocks = task.evaluate(
        minimum.common[:size], minimum.own[:-1], weights=weights, gain=fitted.gain, slopes=slopes, also=held
    )
    assert blocks is not None
    columns = [eliminate(block)[1] for block in blocks]
    total = sum((part.T @ part for part in columns), np.zeros((columns[0].shape[1],) * 2))
    # Order: estimated, held, logarithms. The held are no unknowns.
    unknown = np.r_[0:size, size + len(held) : len(total)]
    known = np.arange(size, size + len(held))
    data = total[np.ix_(unknown, unknown)]
    information = data + np.diag(fitted.prior)
    deviations = np.array([task.model.parameters[place].std for place in held])
    covariance = with_known(inverse(information), information, total[np.ix_(unknown, known)], deviations)
    data_information = data + np.diag(np.concatenate((np.zeros(size), fitted.prior[size:])))
    return assemble(
        task,
        METHOD,
        minimum,
        covariance=covariance[:size, :size],
        data_covariance=inverse(data_information)[:size, :size],
        fit_percent=predicted_percent(fitted, HORIZON),
        seconds=stopwatch() - began,
    )


def predicted_percent(fitted: Fit, horizon: float) -> dict[str, float]:
    """Percent of each output's movement that is predicted `horizon` s ahead, from the filtered state."""
    task, values = fitted.problem, fitted.values
    kernel = task.kernel
    errors: list[Array] = []
    shown: list[Array] = []
    for segment, start in zip(task.segments, fitted.starts, strict=True):
        steps = round(horizon / float(np.median(np.diff(segment.time))))
        filtered = kernel.memory(start)
        predicted = np.empty_like(segment.measured)
        nothing = np.empty((*segment.measured.shape, 0))
        row, skip = 0, False
        while row + steps < len(segment):
            place = {"first": row, "last": row + steps, "substeps": task.substeps}
            if skip:
                ahead = kernel.memory(filtered.x)
                ahead.lag[:], ahead.pointer[:] = filtered.lag, filtered.pointer
                kernel.proceed(segment, values, ahead, None, (), predicted, nothing, skip=True, **place)
                errors.append(segment.measured[row + steps] - predicted[row + steps])
                shown.append(segment.measured[row + steps])
            kernel.proceed(segment, values, filtered, fitted.gain, (), predicted, nothing, skip=skip, **place)
            row, skip = row + steps, True
    if len(errors) < 2:
        return {}
    error, measured = np.array(errors), np.array(shown)
    rms = np.sqrt(np.nanmean(error**2, axis=0)) / np.maximum(np.nanstd(measured, axis=0), 1e-300)
    return {name: float(100.0 * (1.0 - share)) for name, share in zip(kernel.outputs, rms, strict=True)}
