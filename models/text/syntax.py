"""What an equation's text may contain: a whitelist over Python's syntax tree, and the traversal of a validated tree.

Validation is cheap for any text: its length, its depth, its exponents and its numbers are bounded.
"""

from __future__ import annotations

import ast
import difflib
import math
import threading
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from upright.models.parts import ModelError

FUNCTIONS: Mapping[str, tuple[int, Callable[..., float]]] = {
    "sin": (1, math.sin),
    "cos": (1, math.cos),
    "tan": (1, math.tan),
    "asin": (1, math.asin),
    "acos": (1, math.acos),
    "atan": (1, math.atan),
    "sinh": (1, math.sinh),
    "cosh": (1, math.cosh),
    "tanh": (1, math.tanh),
    "exp": (1, math.exp),
    "log": (1, math.log),
    "sqrt": (1, math.sqrt),
    "abs": (1, abs),
    "sign": (1, lambda x: math.copysign(1.0, x) if x else 0.0),
    "min": (2, min),
    "max": (2, max),
}
"""Function name to its number of arguments and its implementation for floats."""

CONSTANTS: Mapping[str, float] = {"pi": math.pi}
OPERATIONS: Mapping[type[ast.operator], Callable[[Any, Any], Any]] = {
    ast.Add: lambda a, b: a + b,
    ast.Sub: lambda a, b: a - b,
    ast.Mult: lambda a, b: a * b,
    ast.Div: lambda a, b: a / b,
    ast.Pow: lambda a, b: a**b,
}
LONGEST = 4000
"""Characters; the equations of vehicles are shorter."""
DEEPEST = 100
"""Levels of nesting."""
LARGEST_EXPONENT = 16
"""Of a numeric exponent; SymPy computes powers of numbers to the last digit."""
MOST_BITS = 1100
"""Of an integer that SymPy computes: about the range of a float."""
ONE_AT_A_TIME = threading.Lock()
"""Python before 3.11.8 and 3.12.2 has one depth counter for the trees of all threads, and raises a SystemError if two
are built at once (https://github.com/python/cpython/issues/106905)."""


def float_operation(operator: type[ast.operator], a: float, b: float) -> float:
    """One operation of OPERATIONS on floats; a power that is not a real number raises ValueError."""
    return math.pow(a, b) if operator is ast.Pow else float(OPERATIONS[operator](a, b))


def validated(text: str, names: frozenset[str] | None, where: str) -> ast.expr:
    """The syntax tree of `text`, every node of which is allowed. Raises ModelError."""
    if len(text) > LONGEST:
        raise ModelError(where, f"is longer than {LONGEST} characters", remedy="split it with definitions.")
    line = " ".join(text.split())
    if "#" in line:
        raise ModelError(where, "a comment is not allowed in an equation", remedy="put it outside the quotes.")
    try:
        with ONE_AT_A_TIME:
            tree = ast.parse(line, mode="eval").body
    except (SyntaxError, ValueError, RecursionError, MemoryError) as error:
        place = f" at character {error.offset}" if isinstance(error, SyntaxError) and error.offset else ""
        remedy = "write it as in Python: 2 * sin(roll) ** 2."
        raise ModelError(where, f"{short(text)!r} is not an expression{place}", remedy=remedy) from error
    _validate(tree, _Context(line, names, where), 0)
    return tree


@dataclass(frozen=True, slots=True)
class _Context:
    text: str
    names: frozenset[str] | None
    where: str

    def source(self, node: ast.expr) -> str:
        """The source text of `node`; without recursion, since it may be nested as deeply as Python can parse."""
        return short(self.text.encode()[node.col_offset : node.end_col_offset].decode(errors="replace"))

    def error(self, message: str, remedy: str) -> ModelError:
        return ModelError(self.where, message, remedy=remedy)


def _validate(node: ast.expr, context: _Context, depth: int) -> float | None:
    """The value of `node` if it consists of numbers alone. Raises ModelError if it is not allowed."""
    if depth > DEEPEST:
        raise context.error(f"is nested deeper than {DEEPEST}", "split it with definitions.")
    match node:
        case ast.Constant(value=bool(value)):
            raise context.error(f"{value} is not a number", "use 0 or 1.")
        case ast.Constant(value=int() | float()):
            return _finite(lambda: float(node.value), node, context)  # type: ignore[arg-type]
        case ast.Name() | ast.Attribute():
            return _validate_name(dotted(node, context.where), context)
        case ast.UnaryOp(op=ast.USub() | ast.UAdd()):
            operand = _validate(node.operand, context, depth + 1)
            return operand if operand is None or isinstance(node.op, ast.UAdd) else -operand
        case ast.BinOp(op=operator) if type(operator) in OPERATIONS:
            a, b = _validate(node.left, context, depth + 1), _validate(node.right, context, depth + 1)
            if isinstance(operator, ast.Pow) and b is not None:
                refuse_large_exponent(b, context.where)
            if isinstance(operator, ast.Div) and b == 0.0:
                raise context.error(f"{context.source(node)} divides by zero", "correct the expression.")
            if a is None or b is None:
                return None
            return _finite(lambda: float_operation(type(operator), a, b), node, context)
        case ast.Call(func=ast.Name(id=name), keywords=[]):
            if name not in FUNCTIONS:
                remedy = f"{_near(name, FUNCTIONS)}use one of: {', '.join(FUNCTIONS)}."
                raise context.error(f"there is no function {name}()", remedy)
            arity, function = FUNCTIONS[name]
            if len(node.args) != arity:
                raise context.error(f"{name}() takes {arity} value(s), not {len(node.args)}", "correct the call.")
            values = [_validate(argument, context, depth + 1) for argument in node.args]
            known = [value for value in values if value is not None]
            return _finite(lambda: function(*known), node, context) if len(known) == arity else None
        case _:
            remedy = f"numbers, names, + - * / **, brackets and {', '.join(FUNCTIONS)} are allowed."
            raise context.error(f"{context.source(node)} is not allowed in an equation", remedy)


def _validate_name(name: str, context: _Context) -> float | None:
    if context.names is not None and name not in context.names and name not in CONSTANTS:
        known = sorted(context.names)
        there = f"use one of: {', '.join(known)}." if known else "write a number."
        raise context.error(f"there is no {short(name)!r}", _near(name, known) + there)
    return CONSTANTS[name] if name in CONSTANTS and name not in (context.names or ()) else None


def _finite(compute: Callable[[], float], node: ast.expr, context: _Context) -> float:
    try:
        value = compute()
    except (ArithmeticError, ValueError) as error:
        what = f"{context.source(node)} has no value ({error})"
        raise context.error(what, "correct the expression.") from error
    if not math.isfinite(value):
        raise context.error(f"{context.source(node)} is not a finite number", "correct the expression.")
    return value


def refuse_large_exponent(exponent: float, where: str) -> None:
    """Raises ModelError if the magnitude of a numeric exponent is larger than LARGEST_EXPONENT."""
    if not abs(exponent) <= LARGEST_EXPONENT:
        what = f"the exponent {exponent:.6g} is larger than {LARGEST_EXPONENT}"
        raise ModelError(where, what, remedy="use exp(), or a smaller exponent.")


def _near(name: str, known: Iterable[str]) -> str:
    """The beginning of a remedy for a name that was misspelt."""
    near = difflib.get_close_matches(name, known, n=1)
    return f"did you mean {near[0]!r}? If not, " if near else ""


def short(text: str) -> str:
    """`text`, shortened to fit into a message."""
    return text if len(text) <= 80 else f"{text[:77]}..."


def dotted(node: ast.expr, where: str) -> str:
    """The name of `node`, dotted as `EFFECT.NAME`. Raises ModelError if it is not a name."""
    parts: list[str] = []
    while isinstance(node, ast.Attribute):
        parts.append(node.attr)
        node = node.value
    if not isinstance(node, ast.Name):
        raise ModelError(
            where, "there is a dot after something that is not a name", remedy="names look like EFFECT.NAME."
        )
    return ".".join([node.id, *reversed(parts)])


def used_names(tree: ast.expr) -> set[str]:
    """The names, including constants, in a validated tree."""
    match tree:
        case ast.Name():
            return {tree.id}
        case ast.Attribute():
            return {dotted(tree, "expression")}
        case ast.UnaryOp():
            return used_names(tree.operand)
        case ast.BinOp():
            return used_names(tree.left) | used_names(tree.right)
        case ast.Call():
            return set().union(*map(used_names, tree.args))
        case _:
            return set()


def fold(
    node: ast.expr,
    *,
    leaf: Callable[[Any], Any],
    name: Callable[[str], Any],
    binary: Callable[[type[ast.operator], Any, Any], Any],
    negative: Callable[[Any], Any],
    call: Callable[[str, list[Any]], Any],
) -> Any:
    """The value of a validated tree in the algebra that the callables define."""

    def value(node: ast.expr) -> Any:
        match node:
            case ast.Constant():
                return leaf(node.value)
            case ast.Name() | ast.Attribute():
                return name(dotted(node, "expression"))
            case ast.UnaryOp():
                operand = value(node.operand)
                return negative(operand) if isinstance(node.op, ast.USub) else operand
            case ast.BinOp():
                return binary(type(node.op), value(node.left), value(node.right))
            case ast.Call(func=ast.Name(id=function)):
                return call(function, [value(argument) for argument in node.args])
            case _:
                raise AssertionError(ast.dump(node))

    return value(node)
