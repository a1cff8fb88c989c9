"""From a model's equations to the source of one numba module: slopes, outputs, their exact derivatives, and the loops.

Every derivative is symbolic; common subexpressions are shared between a function and its derivatives, so a derivative
costs little more than the function. Derivatives by parameters are computed only for columns that are asked for.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import sympy
from sympy.printing.pycode import PythonCodePrinter

from models.equations import Equations, compose
from models.model import Hold, Model

LOOPS = Path(__file__).with_name("kernel_loops.py")


class _Printer(PythonCodePrinter):  # type: ignore[misc]
    """Expressions as numba takes them; `places` says where a symbol's value is found."""

    def __init__(self, places: Mapping[sympy.Symbol, str]) -> None:
        super().__init__({"fully_qualified_modules": True, "human": True})
        self._places = places

    def _print_Symbol(self, expr: sympy.Symbol) -> str:
        return self._places.get(expr, expr.name)

    def _print_Signum(self, expr: sympy.Expr) -> str:
        inner = self._print(expr.args[0])
        return f"(1.0 if {inner} > 0.0 else (-1.0 if {inner} < 0.0 else 0.0))"

    def _print_Magnitude(self, expr: sympy.Expr) -> str:
        return f"abs({self._print(expr.args[0])})"

    def _print_Heaviside(self, expr: sympy.Expr) -> str:
        return f"(1.0 if {self._print(expr.args[0])} > 0.0 else 0.0)"

    def _print_DiracDelta(self, expr: sympy.Expr) -> str:
        return "0.0"

    def _print_Integer(self, expr: sympy.Integer) -> str:
        return f"{int(expr)}.0"

    def _print_Rational(self, expr: sympy.Rational) -> str:
        return repr(float(expr))

    def _print_Pow(self, expr: sympy.Pow, rational: bool = False) -> str:
        base, exponent = expr.args
        if exponent.is_Integer and 2 <= int(exponent) <= 4:
            inner = self.parenthesize(base, 100)
            return "(" + " * ".join([inner] * int(exponent)) + ")"
        if exponent == -1:
            return f"(1.0 / {self.parenthesize(base, 100)})"
        if exponent == sympy.Rational(1, 2):
            return f"math.sqrt({self._print(base)})"
        return f"({self._print(base)} ** {self.parenthesize(exponent, 100)})"


def generate(model: Model) -> str:
    """Source of the module for `model`. The same model gives the same text. Raises ModelError."""
    equations = compose(model)
    places: dict[sympy.Symbol, str] = {equations.time: "t"}
    for array, symbols in (
        ("stage", equations.states),
        ("value", equations.inputs),
        ("slope", equations.slopes),
        ("p", equations.parameters),
    ):
        places |= {symbol: f"{array}[{place}]" for place, symbol in enumerate(symbols)}
    names = [parameter.name for parameter in model.parameters]
    shifts = [(place, names.index(name)) for place, delays in enumerate(equations.delays) for name in delays]
    lags = [names.index(lag) if lag else -1 for lag in equations.lags]
    header = [
        f'"""Generated from the model {model.name}; do not edit: it is made again when it is missing."""',
        "",
        "import math",
        "",
        "import numpy as np",
        "from numba import njit",
        "",
        f"NX, NU, NY, NP = {len(equations.states)}, {len(equations.inputs)}, {len(equations.outputs)}, {len(names)}",
        f"FIRST_ORDER = np.array({[each.hold is Hold.FIRST_ORDER for each in model.inputs]}, dtype=np.bool_)",
        f"DELAY_INPUT = np.array({[shift[0] for shift in shifts]}, dtype=np.int64)",
        f"DELAY_PARAMETER = np.array({[shift[1] for shift in shifts]}, dtype=np.int64)",
        f"LAG = np.array({lags}, dtype=np.int64)",
        f"LAGGING = {any(lag >= 0 for lag in lags)}",
        "NODES = np.array([0.0, 0.5, 0.5, 1.0, 0.0])",
        "WEIGHTS = np.array([1.0 / 6.0, 1.0 / 3.0, 1.0 / 3.0, 1.0 / 6.0])",
        "",
    ]
    blocks = {
        "EQUATIONS_slopes": _block(("f", "A", "B", "G"), equations.derivatives, equations, places),
        "EQUATIONS_observe": _block(("error", "C", "D", "H"), equations.outputs, equations, places),
    }
    lines: list[str] = []
    for line in LOOPS.read_text().split('"""', 2)[2].splitlines():
        text = line.strip()
        indent = " " * (len(line) - len(line.lstrip()))
        if text in blocks:
            lines += [indent + each for each in blocks[text]]
        elif text.startswith("READ_LINE("):
            when, left, value, slope = text.removeprefix("READ_LINE(").removesuffix(")").split("; ")
            lines += [indent + each.format(when=when, left=left, value=value, slope=slope) for each in READ_LINE]
        else:
            lines.append(line)
    return "\n".join([*header, *lines, ""])


READ_LINE = (
    "if FIRST_ORDER[i]:",
    "    when = {when} - delay[i]",
    "    j = pointer[i]",
    "    while j > 0 and knots[j, i] > when:",
    "        j -= 1",
    "    while j < rows - 1 and (knots[j + 1, i] < when or (knots[j + 1, i] == when and not {left})):",
    "        j += 1",
    "    pointer[i] = j",
    "    if j == rows - 1 or when < knots[0, i]:",
    "        {value} = u[j, i]",
    "        {slope} = 0.0",
    "    else:",
    "        {slope} = (u[j + 1, i] - u[j, i]) / (knots[j + 1, i] - knots[j, i])",
    "        {value} = u[j, i] + (when - knots[j, i]) * {slope}",
    "else:",
    "    {value} = u[pointer[i], i]",
)
"""Input i at an instant: held, or on the straight line between two samples; `left` takes the limit from below."""


def _block(
    arrays: tuple[str, str, str, str],
    expressions: Sequence[sympy.Expr],
    equations: Equations,
    places: Mapping[sympy.Symbol, str],
) -> list[str]:
    """Source that writes `expressions` and their derivatives by state, active parameter and input into `arrays`."""
    value, by_state, by_parameter, by_input = arrays
    targets: list[tuple[str, str, sympy.Expr]] = []
    for i, expression in enumerate(expressions):
        targets.append(("", f"{value}[{i}]", expression))
        free = expression.free_symbols
        for array, symbols in ((by_state, equations.states), (by_input, equations.inputs)):
            for j, symbol in enumerate(symbols):
                if symbol in free and (derivative := expression.diff(symbol)) != 0:
                    targets.append(("", f"{array}[{i}, {j}]", derivative))
        for j, symbol in enumerate(equations.parameters):
            if symbol in free and (derivative := expression.diff(symbol)) != 0:
                targets.append((f"column[{j}]", f"{by_parameter}[{i}, column[{j}]]", derivative))
    shared, reduced = sympy.cse([target[2] for target in targets], symbols=sympy.numbered_symbols("q_"), list=False)
    printer = _Printer(places)
    lines = [f"{symbol.name} = {printer.doprint(expression)}" for symbol, expression in shared]
    for (condition, target, _), expression in zip(targets, reduced, strict=True):
        if condition:
            lines += [f"if {condition} >= 0:", f"    {target} = {printer.doprint(expression)}"]
        else:
            lines.append(f"{target} = {printer.doprint(expression)}")
    return lines
