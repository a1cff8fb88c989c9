"""Combinations of parameters, such as a product that a record tells where it does not tell the factors.

A record often knows `mass * height / gain` well and none of the three. The combination's standard deviation is from the
joint covariance of what was estimated and of what was held at a value that is not exact: what held values move in the
estimates cancels where the combination does not depend on them, and is all there where it does.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from estimators.fit_result import inverse
from estimators.gauss_newton import common_information
from estimators.innovations import NoiseModel
from estimators.likelihood import Likelihood
from estimators.methods.prediction_error import Fit
from models.expressions import names_in, parse

Array = NDArray[np.float64]


def joint_covariance(fitted: Fit) -> tuple[tuple[int, ...], Array]:
    """Places of the estimated and of the held parameters that are not exact, and the covariance of both (k, k)."""
    task, minimum = fitted.problem, fitted.minimum
    size, held, unknown = len(task.free), task.uncertain, len(minimum.common)
    covariance = np.zeros((size + len(held), size + len(held)))
    if not held:
        return task.free, inverse(minimum.information)[:size, :size]
    likelihood = Likelihood(task, NoiseModel.of(task), minimum.common, fitted.prior)
    seen = likelihood.of_data(minimum.common, minimum.own, also=held)
    if seen is None:
        raise ArithmeticError("the model runs away from its own estimate")
    # All of one evaluation: what takes the place of a held parameter cancels in a combination only to the last digits.
    information = common_information(seen.normals, unknown + len(held))
    alone = inverse(information[:unknown, :unknown] + np.diag(fitted.prior))
    deviations = np.array([task.model.parameters[place].std for place in held])
    moves = np.concatenate((-(alone @ information[:unknown, unknown:])[:size], np.eye(len(held)))) * deviations
    covariance[:size, :size] = alone[:size, :size]
    covariance += moves @ moves.T
    return (*task.free, *held), covariance


def combinations(fitted: Fit, expressions: Mapping[str, str]) -> dict[str, tuple[float, float]]:
    """Value and standard deviation of each of `expressions` of the model's parameters, by its name.

    Raises ModelError where one is no expression of parameters.
    """
    import sympy

    places, covariance = joint_covariance(fitted)
    kernel, values = fitted.problem.kernel, fitted.values
    symbols = {name: sympy.Symbol(name, real=True) for name in kernel.parameters}
    here = {symbols[name]: float(value) for name, value in zip(kernel.parameters, values, strict=True)}
    found = {}
    for name, text in expressions.items():
        expression = parse(text, symbols, name)
        used = names_in(text)
        slope = np.array(
            [
                float(expression.diff(symbols[kernel.parameters[place]]).subs(here))
                if kernel.parameters[place] in used
                else 0.0
                for place in places
            ]
        )
        found[name] = (float(expression.subs(here)), float(np.sqrt(max(float(slope @ covariance @ slope), 0.0))))
    return found
