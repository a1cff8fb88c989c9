"""Derivatives with kept intermediate results equal SymPy's own."""

from __future__ import annotations

import pytest
import sympy

from upright.models import library
from upright.models.compiler.derivatives import Derivatives
from upright.models.compiler.equations import Magnitude, Signum, compose
from upright.models.effects.catalogue import CATALOGUE

X, Y = sympy.symbols("x y", real=True)


@pytest.mark.parametrize(
    "expression",
    [
        X**3 * sympy.sin(X * Y) / (1 + Y**2),
        X**Y + Y**X + sympy.sqrt(X + Y),
        Magnitude(X * Y) * Signum(X - Y) * sympy.tanh(X / Y),
        sympy.Max(X, Y**2) * sympy.Min(X, Y, 1) + sympy.Heaviside(X) * sympy.exp(-X),
        sympy.log(X) * sympy.atan(Y) * X * Y + 3,
    ],
)
def test_derivatives_of_every_kind_of_expression_equal_sympys(expression: sympy.Expr) -> None:
    derivatives = Derivatives()
    for symbol in (X, Y, sympy.Symbol("z")):
        assert derivatives.by(expression, symbol) == expression.diff(symbol)


def test_derivatives_of_all_effects_of_the_catalogue_equal_sympys() -> None:
    model = library.get("monocab_reduced")
    for name in CATALOGUE:
        model = model.add(name)
    equations, derivatives = compose(model), Derivatives()
    for expression in (*equations.derivatives, *equations.outputs):
        for symbol in (*equations.states, *equations.inputs, *equations.parameters, equations.time):
            assert derivatives.by(expression, symbol) == expression.diff(symbol)
