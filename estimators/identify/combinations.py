"""Combinations of parameters, such as a product that a record tells where it does not tell the factors.

A record often knows `mass * height / gain` well and none of the three. The combination's standard deviation is from the
joint covariance of what was estimated and of what was held at a value that is not exact: what held values move in the
estimates cancels where the combination does not depend on them, and is all there where it does.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from estimators.fit.maximum_likelihood import Fit
from models.expressions import names_in, parse


def combinations(fitted: Fit, expressions: Mapping[str, str]) -> dict[str, tuple[float, float]]:
    """Value and standard deviation of each of `expressions` of the model's parameters, by its name.

    Raises ModelError where one is no expression of parameters.
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
