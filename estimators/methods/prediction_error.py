"""Prediction error: the parameters that best predict each sample from all previous ones.

The fit is that of estimators.fit.maximum_likelihood, which is valid for stable and unstable plants, in open and in
closed loop. Source: Ljung, "System identification", 2nd ed., chapters 7 and 9.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from upright.estimators.contract import Estimate, EstimationError
from upright.estimators.data.as_recorded import as_recorded
from upright.estimators.data.segments import DataError
from upright.estimators.data.time_scale import horizon
from upright.estimators.fit.maximum_likelihood import Fit, fit
from upright.estimators.fit.problem import problem
from upright.estimators.fit.random.disturbance import disturbances, is_of_disturbance
from upright.estimators.fit.released import released
from upright.estimators.fit.result import assemble, inverse, refused, with_known
from upright.estimators.stopwatch import stopwatch
from upright.models import library
from upright.models.compiler.kernel import Progress
from upright.models.model import Model
from upright.models.random.disturbance import disturbed
from upright.telemetry.recording import Recording

Array = NDArray[np.float64]

METHOD = "prediction_error"


def prediction_error(
    model: Model | str,
    recordings: Sequence[Recording],
    *,
    estimate: Iterable[str] | None = None,
    support: float | None = None,
    prior: bool = True,
    progress: Progress | None = None,
) -> Estimate:
    """Fit `model` to `recordings`. `estimate` names the estimated parameters, by default those that the model marks.

    `support`: rad, the vehicle is free at a smaller roll angle; `prior`: use the standard deviations of the model's
    parameters. Data that cannot be used give an Estimate without values that says why. Raises ModelError and
    EstimationError for an invalid model or name.
    """
    began = stopwatch()
    model = as_recorded(library.get(model) if isinstance(model, str) else model, recordings)
    if estimate is not None:
        model = model.change(estimated=estimate)
    model = disturbed(model, recordings)
    try:
        task = problem(model, recordings, support=support, progress=progress)
    except DataError as error:
        return refused(model, METHOD, error, stopwatch() - began)
    fitted = fit(task, prior=prior)
    found = result(fitted, began)
    if not (prior and found.disturbance):
        return found
    try:
        if (more := released(model, fitted)) is not model:
            # A held parameter whose error exceeds the resolution of the data is confounded with a disturbance.
            shaken = fit(problem(more, recordings, support=support, progress=progress))
            found = replace(found, disturbance=disturbances(shaken), seconds=stopwatch() - began)
    except (ArithmeticError, EstimationError, np.linalg.LinAlgError):
        pass  # the estimate with the held parameters is kept
    return found


def result(fitted: Fit, began: float) -> Estimate:
    """The Estimate of a fit; its standard deviations include the uncertainty of held parameters."""
    task, minimum = fitted.problem, fitted.minimum
    size, held, unknown = len(task.free), task.uncertain, len(minimum.common)
    # The information is that at the beginning of the last step, with which all coverage figures were obtained, while
    # `across` is that at its end. They differ by no more than the effect of that step, unless parameters are known only
    # in combinations: in the curved valley of the robot by 7 % of one of them. No linear ± is reliable there.
    information = minimum.information
    covariance = inverse(information)
    if held:
        across = fitted.information(held)[:unknown, unknown:]
        deviations = np.array([task.model.parameters[place].std for place in held])
        covariance = with_known(covariance, information, across, deviations)
    # The prior of a disturbance is not knowledge about the machine.
    shaken = [parameter.name in is_of_disturbance(task.model) for parameter in task.parameters]
    known_before = np.concatenate((np.where(shaken, 0.0, fitted.prior[:size]), np.zeros(unknown - size)))
    return assemble(
        task,
        METHOD,
        minimum,
        covariance=covariance[:size, :size],
        data_covariance=inverse(information - np.diag(known_before))[:size, :size],
        disturbance=disturbances(fitted),
        fit_percent=predicted_percent(fitted, horizon(task.model, task.segments)),
        seconds=stopwatch() - began,
    )


def own_deviations(fitted: Fit) -> dict[str, float]:
    """The standard deviation of each estimated parameter if all held ones were exact. By it the estimates from several
    recordings of a machine scatter: what is held is wrong by the same amount in each."""
    deviations = np.sqrt(np.diag(inverse(fitted.minimum.information)))
    return {parameter.name: float(each) for parameter, each in zip(fitted.problem.parameters, deviations, strict=False)}


def predicted_percent(fitted: Fit, horizon: float) -> dict[str, float]:
    """Percent of each output's variation that is predicted `horizon` s ahead, from the filtered state."""
    task, values = fitted.problem, fitted.values
    kernel = task.kernel
    errors: list[Array] = []
    shown: list[Array] = []
    for segment, start in zip(task.segments, fitted.starts, strict=True):
        steps = max(1, round(horizon / float(np.median(np.diff(segment.time)))))
        predicted, nothing = np.empty_like(segment.measured), np.empty((*segment.measured.shape, 0))
        filtered, free = kernel.memory(start), kernel.memory(start)
        correct, simulate = (
            kernel.ready(segment, values, memory, gain, (), predicted, nothing, substeps=task.substeps)
            for memory, gain in ((filtered, fitted.gain), (free, None))
        )
        for row in range(0, len(segment) - steps, steps):
            if row > 0:
                free.x[:], free.lag[:], free.pointer[:] = filtered.x, filtered.lag, filtered.pointer
                simulate(row, row + steps, True)
                errors.append(segment.measured[row + steps] - predicted[row + steps])
                shown.append(segment.measured[row + steps])
            correct(row, row + steps, row > 0)
    if len(errors) < 2:
        return {}
    error, measured = np.array(errors), np.array(shown)
    rms = np.sqrt(np.nanmean(error**2, axis=0)) / np.maximum(np.nanstd(measured, axis=0), 1e-300)
    return {name: float(100.0 * (1.0 - share)) for name, share in zip(kernel.outputs, rms, strict=True)}
