"""From the minimum of a fit to an Estimate: which parameters are identified, how well, and why others are not.

A parameter is identified if the data alone, without its prior, determine it to half its prior standard deviation (or,
without a prior, to 30 % of its magnitude). Otherwise it has no value, and its reason says whether it hardly affects the
measurements, or with which other parameter it is confounded.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from upright.estimators.contract import Estimate, ParameterEstimate, Status
from upright.estimators.data.segments import DataError
from upright.estimators.disturbance_estimate import DisturbanceEstimate
from upright.estimators.fit.gauss_newton import Minimum
from upright.estimators.fit.problem import Problem
from upright.estimators.numbers import about
from upright.models.model import Model
from upright.models.parts import Parameter
from upright.models.random.disturbance import parameters_of

Array = NDArray[np.float64]

REQUIRED_OF_PRIOR = 0.5
REQUIRED_OF_SIZE = 0.3
NOTHING = 1e-60
"""Information that counts as none; the square of its inverse does not overflow."""


def required_std(parameter: Parameter) -> float:
    """The standard deviation that the data alone have to reach for `parameter`."""
    if parameter.std > 0.0:
        return REQUIRED_OF_PRIOR * parameter.std
    return REQUIRED_OF_SIZE * (parameter.scale or abs(parameter.value) or 1.0)


def inverse(information: Array) -> Array:
    """The inverse of an information matrix (p, p); directions without information get a very large variance."""
    size = np.sqrt(np.maximum(np.diag(information), NOTHING))
    values, vectors = np.linalg.eigh(information / np.outer(size, size))
    values = np.maximum(values, 1e-12)
    return np.asarray((vectors / values) @ vectors.T / np.outer(size, size))


def correlation(covariance: Array) -> Array:
    """Correlation matrix of a covariance matrix (p, p)."""
    size = np.sqrt(np.diag(covariance))
    return np.asarray(covariance / np.outer(size, size))


def assemble(
    problem: Problem,
    method: str,
    minimum: Minimum,
    *,
    covariance: Array,
    data_covariance: Array,
    fit_percent: Mapping[str, float],
    seconds: float,
    disturbance: tuple[DisturbanceEstimate, ...] = (),
) -> Estimate:
    """The Estimate of a fit. `covariance` (p, p) is reported, `data_covariance` (p, p) decides what is identified.

    The correlation time of a disturbance is not a parameter of the machine and is reported with its `disturbance`."""
    parameters: dict[str, ParameterEstimate] = {}
    related = correlation(data_covariance)
    lower, upper = problem.bounds
    bounds_hit = []
    of_disturbance = parameters_of(problem.model.base_states)
    own = [place for place, parameter in enumerate(problem.parameters) if parameter.name not in of_disturbance]
    for place in own:
        parameter = problem.parameters[place]
        alone = float(np.sqrt(data_covariance[place, place]))
        required = required_std(parameter)
        coverage = 100.0 * min(1.0, required / max(alone, 1e-300))
        value, std = float(minimum.common[place]), float(np.sqrt(covariance[place, place]))
        status, reason = Status.OK, ""
        hit = bool(minimum.at_bound[place])
        if hit:
            bounds_hit.append(parameter.name)
        if not minimum.converged:
            status = Status.NOT_CONVERGED
            reason = f"the fit did not converge in {minimum.iterations} steps: the model may be far from the vehicle"
        elif not alone < required:
            status, reason = _unknown(problem, place, related, alone, required)
        elif std > max(2.0 * required, REQUIRED_OF_SIZE * abs(value)):
            status = Status.UNIDENTIFIABLE
            held = ", ".join(problem.model.parameters[number].name for number in problem.uncertain)
            reason = f"it is known only to ± {about(std, parameter.unit)}, since it depends on held values: {held}"
        elif hit and not _is_neutral(parameter, value):
            status = Status.AT_BOUND
            bound = lower[place] if value <= lower[place] else upper[place]
            reason = f"the best value is at its bound, {bound:g} {parameter.unit}: the model lacks something else"
        known = status is Status.OK
        parameters[parameter.name] = ParameterEstimate(
            value if known else None, std if known else None, parameter.unit, status, coverage, reason
        )
    failed = next((p for p in parameters.values() if not p.identifiable), None)
    identified = [each.identifiable for each in parameters.values()]
    shown = np.where(np.outer(identified, identified), correlation(covariance)[np.ix_(own, own)], np.nan)
    return Estimate(
        method=method,
        parameters=parameters,
        status=failed.status if failed else Status.OK,
        reason=failed.reason if failed else "",
        samples=problem.rows,
        span=problem.span,
        fit_percent=dict(fit_percent),
        disturbance=disturbance,
        correlation=shown,
        bounds_hit=tuple(bounds_hit),
        seconds=seconds,
    )


def _is_neutral(parameter: Parameter, value: float) -> bool:
    """Whether `value` is an amplitude of zero, which is valid: the effect is absent."""
    return value == 0.0 and parameter.scale > 0.0


def _unknown(problem: Problem, place: int, related: Array, alone: float, required: float) -> tuple[Status, str]:
    parameter = problem.parameters[place]
    others = np.abs(np.delete(related[place], place))
    names = [each.name for number, each in enumerate(problem.parameters) if number != place]
    reached, wanted = (f"± {about(std, parameter.unit)}" for std in (alone, required))
    reached = f"the record determines {parameter.name} to {reached}, {wanted} is required"
    if len(others) and np.max(others) > 0.9:
        partner = names[int(np.argmax(others))]
        return Status.UNIDENTIFIABLE, f"{reached}: {partner} has the same effect on the measurements; hold one of them"
    return Status.TOO_LITTLE_EXCITATION, f"{reached}: excite it more strongly, over a wider band or for longer"


def refused(model: Model, method: str, error: DataError, seconds: float) -> Estimate:
    """The Estimate if the data cannot be used: no values, and the reason."""
    reason = f"{error}".rstrip(".")
    parameters = {
        p.name: ParameterEstimate(None, None, p.unit, error.status, 0.0, reason)
        for p in model.parameters
        if p.estimated
    }
    return Estimate(method, parameters, error.status, reason, 0, 0.0, seconds=seconds)


def with_known(covariance: Array, information: Array, across: Array, deviations: Array) -> Array:
    """`covariance` (p, p) with the uncertainty of parameters that are held at inexact values included.

    `information` (p, p); `across` (p, k) = J' J between the estimated and the held; `deviations` (k,).
    """
    if not len(deviations):
        return covariance
    moved = inverse(information) @ across * deviations
    return np.asarray(covariance + moved @ moved.T)
