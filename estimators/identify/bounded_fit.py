"""A fit of many parameters within bounds, as that of all 14 numbers of the balancing robot in the paper, and which of
them are identifiable.

The paper minimises the squared error of a simulation. A plant that falls over is predicted one step ahead instead
(estimators.methods.prediction_error), with exact derivatives. There are no priors: only start and bounds are given. At
the minimum the Karush-Kuhn-Tucker conditions hold: inside its bounds no parameter has a slope, and at a bound the slope
points outwards.

Whether a parameter is identifiable follows from the scaled Jacobian (singular values, in units of noise for a change of
100 %) for small changes, and from the profile likelihood for large ones: the least cost with this parameter held at
another value. If it rises by less than RISE up to a bound, the parameter is not identifiable from the record.
Sources: Hassan, Moustafa, Moness, section 4.2; Nocedal, Wright, Numerical Optimization, section 12.3; Raue et al.,
Bioinformatics 25 (2009) 1923 (profile likelihood).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from math import isfinite

import numpy as np
from numpy.typing import NDArray

from upright.estimators.contract import EstimationError
from upright.estimators.fit.gauss_newton import Normal, common_information
from upright.estimators.fit.innovations import WIDEST
from upright.estimators.fit.likelihood import Likelihood
from upright.estimators.fit.maximum_likelihood import Fit, fit
from upright.estimators.fit.problem import problem
from upright.estimators.tails import chi2_ppf
from upright.models.compiler.kernel import Progress
from upright.models.model import Model
from upright.telemetry.recording import Recording

Array = NDArray[np.float64]

RISE = 0.5 * float(chi2_ppf(0.95, 1))
"""Rise of the cost, a negative log-likelihood, beyond which a value is outside the 95 % interval."""
ITERATIONS = 300
"""Largest number of steps: a fit may go from bound to bound, along directions that are hardly identifiable."""
CHANGE = 0.01
"""Relative change of a parameter with which the sensitivity of the cost is computed."""


@dataclass(frozen=True, slots=True)
class BoundedFit:
    """A minimum within bounds. Arrays are in the order of `parameters`, (p,).

    `kkt_residual` is the largest slope of the cost along a parameter that is not at a bound, for a change by its own
    standard deviation with all others held, 0 at an exact minimum. `multipliers` are the slopes of the parameters at a
    bound, by name, >= 0. `sensitivity` is the rise of the cost if one parameter alone is changed by 1 %.
    `singular_values` (p,) and `directions` (p, p), one per row, are those of the Jacobian with respect to relative
    changes: a change of 1 / singular value along a direction is one standard deviation.
    """

    fit: Fit
    parameters: tuple[str, ...]
    start: Array
    values: Array
    kkt_residual: float
    multipliers: Mapping[str, float]
    sensitivity: Array
    singular_values: Array
    directions: Array

    @property
    def costs(self) -> Array:
        """The cost at the start and after each step."""
        return np.array([step.cost for step in self.fit.steps])

    @property
    def path(self) -> Array:
        """The parameters at the start and after each step, (n, p)."""
        return np.array([step.common[: len(self.parameters)] for step in self.fit.steps])

    @property
    def determined(self) -> int:
        """Number of combinations that are determined to within 30 %, at two standard deviations."""
        return int(np.sum(self.singular_values > 2.0 / 0.3))


@dataclass(frozen=True, slots=True)
class Profile:
    """Rise of the least cost with `parameter` held at `values` (n,) over that of the fit: `rises` (n,), inf if the fit
    fails.

    `interval` is the range in which it rises by less than RISE; an end is None if it does not rise more up to the
    bound.
    """

    parameter: str
    values: Array
    rises: Array
    interval: tuple[float | None, float | None]

    @property
    def identifiable(self) -> bool:
        """Whether the parameter is identifiable: the record limits it on both sides more narrowly than its bounds."""
        return None not in self.interval


def with_table(model: Model, table: Mapping[str, tuple[float, float, float]]) -> Model:
    """`model` with start value, lower and upper bound of each parameter of `table`, by name.

    Raises EstimationError for values that are not finite, bounds that cross and a start outside the bounds; ModelError
    for an unknown name.
    """
    for name, (value, lower, upper) in table.items():
        unit = model.parameter(name).unit
        if not all(map(isfinite, (value, lower, upper))):
            raise EstimationError(f"parameter {name}", "start and bounds must be numbers", remedy="correct the table.")
        if not lower < upper:
            what = f"its bounds cross: {lower:g} and {upper:g} {unit}"
            raise EstimationError(f"parameter {name}", what, remedy="give the lower one first.")
        if not lower <= value <= upper:
            what = f"the start, {value:g} {unit}, is outside {lower:g} to {upper:g}"
            raise EstimationError(f"parameter {name}", what, remedy="start inside the bounds.")
    rows = {each.name: (each.value, each.lower, each.upper) for each in model.base_parameters} | dict(table)
    changed = [
        replace(each, value=value, lower=lower, upper=upper)
        for each in model.base_parameters
        for value, lower, upper in (rows[each.name],)
    ]
    return replace(model, base_parameters=tuple(changed))


def bounded_fit(
    model: Model,
    recordings: Sequence[Recording],
    *,
    estimate: Iterable[str] | None = None,
    support: float | None = None,
    progress: Progress | None = None,
) -> BoundedFit:
    """Fit `model` from its values within its bounds; by default all parameters that are not known exactly.

    Raises DataError if the recordings cannot be used, EstimationError for an invalid start or bounds, ArithmeticError
    if the model diverges at the start, as it does with physically impossible values.
    """
    names = [each.name for each in model.parameters if each.std > 0.0] if estimate is None else list(estimate)
    task = problem(model, recordings, estimate=names, support=support, progress=progress)
    return examined(fit(task, prior=False, iterations=ITERATIONS))


def examined(fitted: Fit) -> BoundedFit:
    """The analysis of a fit without priors."""
    task, minimum = fitted.problem, fitted.minimum
    size = len(task.free)
    likelihood = replace(Likelihood.of(task, np.zeros(size)), prior=fitted.prior)
    seen = likelihood(minimum.common, minimum.own)
    if seen is None:
        raise ArithmeticError("the model diverges at its own estimate")
    slope, curvature = _reduced(seen.normals, len(minimum.common))
    lower, upper = (np.concatenate((each, np.full(len(slope) - size, w))) for each, w in _widened(task.bounds))
    common = minimum.common
    at_lower, at_upper = common <= lower, common >= upper
    inside = ~((at_lower & (slope >= 0.0)) | (at_upper & (slope <= 0.0)))
    unit = np.sqrt(np.maximum(np.diag(curvature), 1e-300))
    names = tuple(each.name for each in task.parameters)
    # Eliminate the noise: effects that it can imitate carry no information about the parameters.
    values = common[:size]
    information = common_information([Normal(curvature, slope)], size)
    turned, squares, _ = np.linalg.svd(values[:, None] * information * values)
    return BoundedFit(
        fit=fitted,
        parameters=names,
        start=task.start,
        values=values,
        kkt_residual=float(np.max(np.abs(slope / unit)[inside], initial=0.0)),
        multipliers={
            names[place]: float(slope[place] if at_lower[place] else -slope[place])
            for place in range(size)
            if not inside[place]
        },
        sensitivity=0.5 * np.diag(curvature)[:size] * (CHANGE * values) ** 2,
        singular_values=np.sqrt(squares),
        directions=turned.T,
    )


def profile(found: BoundedFit, name: str, *, points: int = 3) -> Profile:
    """The profile likelihood of one parameter, at `points` values to either side up to its bounds.

    Raises EstimationError for a parameter that was not estimated.
    """
    if name not in found.parameters:
        raise EstimationError(f"parameter {name}", "was not estimated", remedy=f"use {', '.join(found.parameters)}.")
    task = found.fit.problem
    place = found.parameters.index(name)
    best, parameter = float(found.values[place]), task.parameters[place]
    others = [each for each in found.parameters if each != name]
    model = task.model.change(dict(zip(found.parameters, found.values.tolist(), strict=True)))
    shares = np.arange(1, points + 1) / points
    values, rises = [best], [0.0]
    for bound in (parameter.lower, parameter.upper):
        if bound == best:
            continue
        there, last = model, found.fit
        # Nearer values first, with quadratic spacing: each fit starts at the result of the previous one.
        for share in shares**2:
            value = best + share * (bound - best)
            held = there.change({name: value})
            try:
                rows = problem(held, (), estimate=others, rows=task.segments)
                again = fit(rows, prior=False, iterations=ITERATIONS, near=last)
            except ArithmeticError:
                values.append(value)
                rises.append(np.inf)
                break
            last = again
            free = [each.name for each in again.problem.parameters]
            there = there.change(dict(zip(free, again.minimum.common[: len(free)].tolist(), strict=True)))
            values.append(value)
            rises.append(max(again.minimum.cost - found.fit.minimum.cost, 0.0))
            if rises[-1] > 100.0 * RISE:
                break
    order = np.argsort(values)
    at, up = np.array(values)[order], np.array(rises)[order]
    return Profile(name, at, up, _interval(at, up, best))


def _interval(values: Array, rises: Array, best: float) -> tuple[float | None, float | None]:
    """The values at which `rises` exceed RISE on either side of `best`, by a parabola between the points."""
    edges: list[float | None] = []
    for side in (values <= best, values >= best):
        away = np.abs(values[side] - best)
        order = np.argsort(away)
        height = np.sqrt(np.minimum(rises[side][order], 1e12))
        beyond = np.flatnonzero(height > np.sqrt(RISE))
        if not len(beyond):
            edges.append(None)
            continue
        last = int(beyond[0])
        span = np.interp(np.sqrt(RISE), height[last - 1 : last + 1], away[order][last - 1 : last + 1])
        edges.append(best + float(span) * (-1.0 if not edges else 1.0))
    return edges[0], edges[1]


def _widened(bounds: tuple[Array, Array]) -> tuple[tuple[Array, float], tuple[Array, float]]:
    """Each bound with that of the logarithms of the noise."""
    return (bounds[0], -WIDEST), (bounds[1], WIDEST)


def _reduced(normals: Sequence[Normal], common: int) -> tuple[Array, Array]:
    """Slope (p + q,) and curvature of the common unknowns, with the own ones of each segment eliminated."""
    slope, curvature = np.zeros(common), np.zeros((common, common))
    for normal in normals:
        across, square = normal.matrix[:common, common:], normal.matrix[common:, common:]
        gain = np.linalg.solve(square, across.T).T if square.size else across
        slope += normal.vector[:common] - gain @ normal.vector[common:]
        curvature += normal.matrix[:common, :common] - gain @ across.T
    return slope, curvature
