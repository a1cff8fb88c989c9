"""Combinations of parameters, such as a product that is identifiable although its factors are not.

A record often determines `mass * height / gain` well and none of the three. The combination's standard deviation
follows from the joint covariance of the estimated parameters and of those held at inexact values. The effect of a held
value on the estimates cancels if the combination does not depend on it, and is fully included if it does.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from upright.estimators.fit.maximum_likelihood import Fit
from upright.models.text.expressions import names_in, parse


def combinations(fitted: Fit, expressions: Mapping[str, str]) -> dict[str, tuple[float, float]]:
    """Value and standard deviation of each of `expressions` of the model's parameters, by its name.

    Raises ModelError if one is not an expression of parameters.
    """
    import sympy

    places, covariance = fitted.joint_covariance()
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
