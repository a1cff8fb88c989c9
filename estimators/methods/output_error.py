"""Output error: the parameters with the smallest simulation error, with fitted initial states.

    minimise  sum over samples of (measured - simulated)^2 / variance of the channel           (4), (5) of the paper

An unstable plant can be simulated for a short time only: an initial error grows as exp(pole * time). Its record is cut
into windows, each with its own initial state. There are two optimisers for the same problem: a trust region
(Levenberg-Marquardt with bounds) with exact sensitivities, and the simplex search of the paper, which needs none.

Simulation errors are correlated between samples. So standard deviations follow from the actual variation of the
gradient between windows (or, in one long window, over time), without assuming independent samples.
Source: Griese et al., section III-A; Nelder and Mead as in Lagarias et al. (1998); sandwich covariance: White (1982),
Newey and West (1987).
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from upright.estimators.contract import Estimate, EstimationError
from upright.estimators.data.segments import DataError
from upright.estimators.fit.gauss_newton import Block, Minimum, eliminate, minimise
from upright.estimators.fit.problem import Problem, jacobian, problem
from upright.estimators.fit.result import assemble, inverse, refused, with_known
from upright.estimators.stopwatch import stopwatch
from upright.models import library
from upright.models.compiler.kernel import Progress, compile_model
from upright.models.model import Model
from upright.telemetry.recording import Recording

Array = NDArray[np.float64]

METHOD = "output_error"
SIMPLEX = "output_error_simplex"
GROWTH = 4.5
"""Natural logarithm of the growth of an initial error within a window, at most."""
ROUNDS = 3
"""Number of alternating estimates of the parameters and the channels' variances."""
CLUSTERS = 8
"""Fewest windows with which the gradient's variance is computed between windows."""


def output_error(
    model: Model | str,
    recordings: Sequence[Recording],
    *,
    estimate: Iterable[str] | None = None,
    support: float | None = None,
    window: float | None = None,
    progress: Progress | None = None,
) -> Estimate:
    """Fit by the trust region. `window` s is the length of a simulation; by default it follows from the unstable pole.

    `estimate` names the estimated parameters, by default those that the model marks; `support`: rad, the vehicle is
    free at a smaller roll angle. Data that cannot be used give an Estimate without values that says why. Raises
    ModelError and EstimationError for an invalid model, name or window.
    """
    return _output_error(METHOD, model, recordings, estimate, support, window, progress)


def output_error_simplex(
    model: Model | str,
    recordings: Sequence[Recording],
    *,
    estimate: Iterable[str] | None = None,
    support: float | None = None,
    window: float | None = None,
    progress: Progress | None = None,
) -> Estimate:
    """Fit by the simplex search, as in the paper. Arguments and errors as for `output_error`."""
    return _output_error(SIMPLEX, model, recordings, estimate, support, window, progress)


def _output_error(
    method: str,
    model: Model | str,
    recordings: Sequence[Recording],
    estimate: Iterable[str] | None,
    support: float | None,
    window: float | None,
    progress: Progress | None,
) -> Estimate:
    began = stopwatch()
    model = library.get(model) if isinstance(model, str) else model
    if window is not None and not window > 0.0:
        raise EstimationError("window", f"{window:g} s is invalid", remedy="give a positive length, or none.")
    try:
        task = problem(model, recordings, estimate=estimate, support=support, longest=window, progress=progress)
        if window is None and (length := longest_window(task)) is not None:
            task = problem(model, recordings, estimate=estimate, support=support, longest=length, progress=progress)
    except DataError as error:
        return refused(model, method, error, stopwatch() - began)
    task, minimum, weights = fit(task, simplex=method == SIMPLEX)
    return _result(task, method, minimum, weights, began)


def longest_window(task: Problem) -> float | None:
    """Longest useful simulation with the model's values, s; None for a stable plant."""
    kernel = compile_model(task.model)
    pole = float(np.max(np.linalg.eigvals(jacobian(kernel, kernel.vector(), task.segments)).real))
    return GROWTH / pole if pole > 0.01 / task.span else None


def fit(task: Problem, *, simplex: bool = False) -> tuple[Problem, Minimum, Array]:
    """`task` with sufficiently short steps, the minimum, and the outputs' weights (ny, ny) there.

    Raises ArithmeticError if the simulation diverges at the start values.
    """
    lower, upper = task.bounds
    common, own = task.start, task.own_start
    weights = np.diag([1.0 / output.noise for output in task.model.outputs])
    minimum: Minimum | None = None
    for turn in range(ROUNDS):
        evaluate = partial(task.evaluate, weights=weights)
        if simplex:
            common, own = _simplex(task, weights, common, own)
        last = turn == ROUNDS - 1
        minimum = minimise(
            evaluate,
            common,
            own,
            scale=task.scale,
            lower=common if simplex else lower,
            upper=common if simplex else upper,
            tolerance=1e-4 if last else 1e-3,
        )
        if minimum is None:
            raise ArithmeticError("the simulation diverges at the start values: use prediction_error")
        common, own = minimum.common, list(minimum.own)
        if not last:
            weights = weights @ np.diag(1.0 / _spread(minimum.blocks, task))
            task = task.refined(common)
    assert minimum is not None
    return task, minimum, weights


def _spread(blocks: Sequence[Block], task: Problem) -> Array:
    """Root mean square of each output's weighted error, (ny,)."""
    outputs = len(task.model.outputs)
    errors = [
        block.residual[: len(segment) * outputs].reshape(-1, outputs)
        for block, segment in zip(blocks, task.segments, strict=True)
    ]
    return np.asarray(np.maximum(np.sqrt(np.mean(np.concatenate(errors) ** 2, axis=0)), 1e-9))


def _simplex(task: Problem, weights: Array, common: Array, own: list[Array]) -> tuple[Array, list[Array]]:
    """Nelder-Mead over the parameters; at each point the initial states are optimised by one linear step."""
    lower, upper = task.bounds
    starts = own

    def cost(scaled: Array) -> float:
        trial = common + scaled * task.scale
        if np.any(trial < lower) or np.any(trial > upper):
            return np.inf
        blocks = task.evaluate(trial, starts, weights=weights)
        if blocks is None:
            return np.inf
        return sum(float(residual @ residual) for residual, _ in map(eliminate, blocks))

    size = len(common)
    corners = np.vstack((np.zeros(size), 0.5 * np.eye(size)))
    options = {"initial_simplex": corners, "xatol": 1e-5, "fatol": 1e-7, "maxiter": 400 * size}
    found = minimize(cost, np.zeros(size), method="Nelder-Mead", options=options)
    return common + found.x * task.scale, own


def _result(task: Problem, method: str, minimum: Minimum, weights: Array, began: float) -> Estimate:
    held = task.uncertain
    blocks = task.evaluate(minimum.common, minimum.own, weights=weights, also=held)
    assert blocks is not None
    size = len(task.free)
    reduced = [eliminate(block) for block in blocks]
    total = sum((columns.T @ columns for _, columns in reduced), np.zeros((size + len(held),) * 2))
    information = total[:size, :size]
    spread = inverse(information)
    varied = _score_covariance([columns[:, :size] * residual[:, None] for residual, columns in reduced])
    data = spread @ np.where(np.isfinite(varied), varied, information) @ spread
    # Never smaller than for independent samples.
    data *= max(1.0, float(np.max(np.diag(spread) / np.maximum(np.diag(data), 1e-300))))
    deviations = np.array([task.model.parameters[place].std for place in held])
    covariance = with_known(data, information, total[:size, size:], deviations)
    if method == SIMPLEX:
        lower, upper = task.bounds
        at_bound = (minimum.common <= lower) | (minimum.common >= upper)
        minimum = replace(minimum, converged=True, at_bound=at_bound)
    estimate = assemble(
        task,
        method,
        minimum,
        covariance=covariance,
        data_covariance=data,
        fit_percent=simulated_percent(task, minimum),
        seconds=stopwatch() - began,
    )
    return replace(estimate, window=max(segment.duration for segment in task.segments))


def _score_covariance(scores: Sequence[Array]) -> Array:
    """Covariance (p, p) of the sum of all scores, (n, p) each, which are correlated within a window."""
    if len(scores) >= CLUSTERS:
        sums = np.array([np.sum(rows, axis=0) for rows in scores])
        return np.asarray(sums.T @ sums * len(sums) / (len(sums) - 1))
    total = np.zeros((scores[0].shape[1],) * 2)
    for rows in scores:
        lags = max(1, len(rows) // 20)
        total += rows.T @ rows
        for lag in range(1, lags):
            across = rows[lag:].T @ rows[:-lag]
            total += (1.0 - lag / lags) * (across + across.T)
    return total


def simulated_percent(task: Problem, minimum: Minimum) -> dict[str, float]:
    """Percent of each output's variation that the simulation explains."""
    errors, shown = [], []
    values = task.values(minimum.common)
    for segment, initial, part in zip(task.segments, task.initials, minimum.own, strict=True):
        start = initial.copy()
        start[list(task.own)] = part
        run = task.kernel.run(segment, values, start, substeps=task.substeps)
        errors.append(segment.measured - run.predicted)
        shown.append(segment.measured)
    error, measured = np.concatenate(errors), np.concatenate(shown)
    share = np.sqrt(np.nanmean(error**2, axis=0)) / np.maximum(np.nanstd(measured, axis=0), 1e-300)
    return {name: float(100.0 * (1.0 - each)) for name, each in zip(task.kernel.outputs, share, strict=True)}
