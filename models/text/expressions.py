"""Equations as text: a whitelist over Python's syntax tree, never eval.

Allowed are numbers, names (also dotted: `static_torque.torque`), + - * / **, parentheses, `pi`, the functions in
FUNCTIONS, and line breaks. `parse` converts a text to a SymPy expression, `number` to a float, `renamed` to
another text; `check` only validates it.
"""

from __future__ import annotations

import ast
import functools
import keyword
import math
from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING

from upright.models.parts import ModelError
from upright.models.text.syntax import (
    CONSTANTS,
    FUNCTIONS,
    MOST_BITS,
    OPERATIONS,
    dotted,
    float_operation,
    fold,
    refuse_large_exponent,
    short,
    used_names,
    validated,
)

if TYPE_CHECKING:
    import sympy

__all__ = ["FUNCTIONS", "check", "length", "name_problem", "names_in", "number", "parse", "renamed"]


def check(text: str, names: Iterable[str], where: str = "expression") -> None:
    """Raises ModelError unless `text` is an allowed expression that uses no names other than `names`."""
    validated(text, frozenset(names), where)


@functools.lru_cache(maxsize=4096)
def names_in(text: str, where: str = "expression") -> frozenset[str]:
    """The names that `text` uses, without functions and constants. Raises ModelError."""
    tree = validated(text, None, where)
    return frozenset(name for name in used_names(tree) if name not in CONSTANTS)


def name_problem(name: str) -> str:
    """Why `name` cannot be a name in an expression; "" if it can."""
    if not (name.isascii() and name.isidentifier()):
        return "is not a valid name: use letters without accents, digits and _, with no digit first"
    if name in FUNCTIONS:
        return "is the name of a function"
    if name in CONSTANTS or name == "time":
        return "is predefined in every equation"
    return "is a keyword of Python" if keyword.iskeyword(name) else ""


def length(text: str, lengths: Mapping[str, int], where: str = "expression") -> int:
    """Terms and operations of `text` once the names in `lengths` are replaced by expressions of these lengths."""
    return int(
        fold(
            validated(text, None, where),
            leaf=lambda _: 1,
            name=lambda name: lengths.get(name, 1),
            binary=lambda _, a, b: a + b + 1,
            negative=lambda a: a + 1,
            call=lambda _, arguments: sum(arguments) + 1,
        )
    )


def number(text: str | float, values: Mapping[str, float], where: str = "expression") -> float:
    """The value of `text` for the `values` of its names. Raises ModelError, also if the value is not finite."""
    if isinstance(text, (int, float)):
        return float(text)
    tree = validated(text, frozenset(values), where)
    try:
        value = fold(
            tree,
            leaf=float,
            name=lambda name: CONSTANTS[name] if name in CONSTANTS else float(values[name]),
            binary=float_operation,
            negative=lambda a: -a,
            call=lambda name, arguments: FUNCTIONS[name][1](*arguments),
        )
    except (ArithmeticError, ValueError) as error:
        raise ModelError(where, f"{text!r} has no value ({error})", remedy="correct the expression.") from error
    if not math.isfinite(value):
        raise ModelError(where, f"{text!r} is {value}", remedy="correct the expression.")
    return float(value)


def parse(text: str, symbols: Mapping[str, sympy.Expr], where: str = "expression") -> sympy.Expr:
    """`text` as a SymPy expression, its names replaced by `symbols`. Raises ModelError."""
    import sympy

    functions = {name: getattr(sympy, name) for name in FUNCTIONS if hasattr(sympy, name)}
    functions |= {"abs": sympy.Abs, "min": sympy.Min, "max": sympy.Max}
    tree = validated(text, frozenset(symbols), where)

    def bounded(expression: sympy.Expr) -> sympy.Expr:
        """SymPy evaluates numbers as they arise, also from `x - x`: they must not grow from step to step."""
        numeric = expression.is_number
        numbers = expression.atoms(sympy.Rational) if numeric else {expression.as_coeff_Mul()[0]}
        large = any(n.is_Rational and max(abs(n.p).bit_length(), n.q.bit_length()) > MOST_BITS for n in numbers)
        if large or (numeric and abs(expression.evalf(5)) > 1e308):
            remedy = "correct the expression."
            raise ModelError(where, f"{short(text)!r} contains a number that is too large", remedy=remedy)
        return expression

    def binary(operator: type[ast.operator], a: sympy.Expr, b: sympy.Expr) -> sympy.Expr:
        if operator is ast.Pow and not b.free_symbols:
            refuse_large_exponent(float(b), where)
        return bounded(OPERATIONS[operator](a, b))

    try:
        expression = fold(
            tree,
            leaf=lambda value: sympy.Integer(int(value)) if float(value).is_integer() else sympy.Float(value),
            name=lambda name: sympy.pi if name == "pi" and name not in symbols else symbols[name],
            binary=binary,
            negative=lambda a: -a,
            call=lambda name, arguments: bounded(functions[name](*arguments)),
        )
    except (TypeError, ValueError, ArithmeticError):
        expression = sympy.nan  # SymPy had to compare or convert something that is not a real number
    if expression.has(sympy.zoo, sympy.nan, sympy.oo, sympy.I):
        raise ModelError(where, f"{short(text)!r} is not a real number", remedy="correct the expression.")
    return expression


def renamed(text: str, replacements: Mapping[str, str], where: str = "expression") -> str:
    """`text` with names replaced by other names or expressions, in brackets where needed. Raises ModelError.

    A replacement that is not an expression (`friction@trim.torque`) is inserted as it is.
    """
    tree = validated(text, None, where)
    if not used_names(tree) & replacements.keys():
        return " ".join(text.split())

    class Renaming(ast.NodeTransformer):
        def replaced(self, node: ast.Name | ast.Attribute) -> ast.expr:
            name = dotted(node, where)
            if name not in replacements:
                return node
            new = replacements[name]
            return ast.Name(new) if "@" in new else validated(new, None, where)

        def visit_Call(self, node: ast.Call) -> ast.expr:
            return ast.Call(node.func, [self.visit(argument) for argument in node.args], [])

        visit_Name = visit_Attribute = replaced

    return ast.unparse(Renaming().visit(tree))
