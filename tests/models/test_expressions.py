"""Equations as text: allowed ones mean the same as in Python, and all others are refused without delay."""

from __future__ import annotations

import gc
import math
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor

import pytest
import sympy
from hypothesis import given, settings
from hypothesis import strategies as st

from upright.models.parts import ModelError
from upright.models.text import expressions
from upright.models.text.expressions import check, length, name_problem, names_in, number, parse, renamed

X, Y = sympy.symbols("x y", real=True)
SYMBOLS = {"x": X, "y": Y, "drag.size": sympy.Symbol("drag.size", real=True)}

# No test takes a second; computing a huge power to its last digit would take for ever.
pytestmark = pytest.mark.timeout(20)


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("2 * x + y", 6.5),
        ("-x ** 2", -9.0),
        ("2 ** -x", 0.125),
        ("x / y / 2", 3.0),
        ("x - y - 1", 1.5),
        ("sin(pi / 2) + cos(0)", 2.0),
        ("min(x, y) - max(x, y)", -2.5),
        ("abs(-x) * sign(-y) + sign(0)", -3.0),
        ("sqrt(exp(log(x ** 2)))", 3.0),
        ("atan(tan(y)) + asin(sin(y)) + acos(cos(y))", 1.5),
        ("sinh(y) - cosh(y) + tanh(0)", -math.exp(-0.5)),
        ("drag.size * 1e-3", 0.007),
        ("  x +\n    y  ", 3.5),
        ("0x10 + 1_000", 1016.0),
        ("+x", 3.0),
    ],
)
def test_equation_has_the_same_value_as_in_python(text: str, value: float) -> None:
    values = {"x": 3.0, "y": 0.5, "drag.size": 7.0}
    check(text, values)
    assert number(text, values) == pytest.approx(value, rel=1e-14)
    symbols = {name: SYMBOLS[name] for name in values}
    expression = parse(text, symbols).subs({symbols[name]: value for name, value in values.items()})
    assert float(expression) == pytest.approx(value, rel=1e-14)


HOSTILE = {
    "import": "__import__('os').system('true')",
    "builtin": "eval(x)",
    "open": "open(x)",
    "attribute of a name": "x.__class__",
    "attribute of a number": "(1).real",
    "attribute of a call": "sin(x).real",
    "attribute of a string": "''.join",
    "call of an attribute": "drag.size(x)",
    "call of a call": "sin(x)(y)",
    "lambda": "lambda: x",
    "comprehension": "[x for x in y]",
    "generator": "sum(x for y in y)",
    "subscript": "x[0]",
    "slice": "x[0:1]",
    "text": "'x'",
    "text that grows": "'x' * 999999999",
    "formatted text": "f'{x}'",
    "bytes": "b'x'",
    "assignment": "x = 3",
    "walrus": "(x := 3)",
    "statement": "x; y",
    "two lines that are two": "x\ny",
    "keyword argument": "sin(x=1)",
    "star": "sin(*x)",
    "tuple": "x, y",
    "dictionary": "{x: y}",
    "comparison": "x < y",
    "condition": "x if y else x",
    "and": "x and y",
    "not": "not x",
    "matrix product": "x @ y",
    "remainder": "x % y",
    "floor": "x // y",
    "shift": "1 << 999999999",
    "invert": "~1",
    "await": "await x",
    "yield": "(yield)",
    "true": "True",
    "none": "None",
    "dots": "...",
    "complex": "2j",
    "infinite": "1e999",
    "division by zero": "x / 0",
    "division by a hidden zero": "x / (2 - 2)",
    "root of a negative number": "sqrt(-1)",
    "logarithm of zero": "log(0)",
    "too many arguments": "sin(x, y)",
    "too few arguments": "min(x)",
    "unknown name": "z",
    "unknown function": "integrate(x)",
    "function as a name": "sin + 1",
    "a letter that looks like x": "х",
    "a ligature": "ﬁ",
    "letters that are read as others": "𝔵 + ｚ",
    "empty": "",
    "blank": " \n ",
    "unbalanced": "x) + (y",
    "comment": "x # y",
    "comment that hides a line": "x # note\n+ y",
    "null": "x\0",
    "half a character": "x\ud800",
    "huge power": "9 ** 999999999",
    "tower": "9 ** 9 ** 9",
    "tower of small powers": "((((9 ** 16) ** 16) ** 16) ** 16) ** 16",
    "tower of fractions": "(((((1 / 9) ** 16) ** 16) ** 16) ** 16) ** -16",
    "power of a root": "sqrt(2) ** 999999999",
    "power of a product": "(9 * x) ** 999999999",
    "huge exponential": "max(exp(exp(exp(100))), 1)",
    "huge whole number": "0x" + "F" * 3900,
    "long": "x + " * 2000 + "x",
    "many terms": "+".join("x" * 1500),
    "many signs": "-" * 3900 + "x",
    "many negations": "not " * 900 + "x",
    "many brackets": "(" * 1900 + "x" + ")" * 1900,
    "many lists": "[" * 190 + "]" * 190,
    "many calls": "sin(" * 150 + "x" + ")" * 150,
    "many dots": "x" + ".a" * 1900,
    "many conditions": " if x else ".join("x" * 300),
    "many powers": "**".join("x" * 1500),
}


@pytest.mark.parametrize("text", HOSTILE.values(), ids=HOSTILE.keys())
def test_anything_else_is_refused_before_it_is_evaluated(text: str) -> None:
    for read in (lambda: check(text, SYMBOLS, "here"), lambda: parse(text, SYMBOLS, "here")):
        with pytest.raises(ModelError) as caught:
            read()
        assert caught.value.where == "here"
        assert caught.value.remedy
        assert len(str(caught.value)) < 600  # the message does not repeat 4000 characters


@pytest.mark.parametrize(
    "text",
    [
        "(x - x + 9) ** (10 ** 9 + x - x)",  # becomes a number only while SymPy builds the expression
        "x ** (y - y + 10 ** 10)",
        "((((x - x + 9) ** 16) ** 16) ** 16) ** 16",
        "((((9 * x) ** 16) ** 16) ** 16) ** 16",
        "(((((x - x + 1 - 1 / 9) ** 16) ** 16) ** 16) ** 16) ** 16",
        "abs(exp(exp(exp(x - x + 100))))",
        "max(exp(exp(exp(x - x + 100))), 1)",
        "x / (y - y)",
        "sqrt(x - x - 1)",
        "max(sqrt(x - x - 1), x)",
        "log(x - x)",
    ],
)
def test_invalid_number_that_arises_only_in_sympy_is_refused(text: str) -> None:
    with pytest.raises(ModelError) as caught:
        parse(text, SYMBOLS, "here")
    assert caught.value.where == "here"


def test_huge_number_built_up_over_several_definitions_is_refused() -> None:
    symbols = {"d1": parse("9 ** 16", {})}
    symbols["d2"] = parse("d1 ** 16", symbols)
    with pytest.raises(ModelError, match="too large"):
        parse("d2 ** 16", symbols)


@given(st.text(alphabet="xy01. +-*/(),\n'\"[]:=#sinmaxpe_{}@\\", max_size=60))
@settings(max_examples=400, derandomize=True, deadline=None)
def test_any_text_is_a_valid_expression_or_a_model_error(text: str) -> None:
    names = {"x": 0.5, "y": 2.0}
    try:
        check(text, names)
    except ModelError:
        with pytest.raises(ModelError):
            number(text, names)
        return
    assert names_in(text) <= set(names)
    assert length(text, {}) >= 1
    try:
        value = number(text, names)
    except ModelError:
        return  # for example 1 / (x - 0.5)
    assert math.isfinite(value)
    assert number(renamed(text, {"x": "1 - y / 4"}), {"y": 2.0}) == pytest.approx(value, rel=1e-9, abs=1e-9)


def test_error_message_suggests_a_correction() -> None:
    with pytest.raises(ModelError, match=r"there is no 'roll_rte'.*did you mean 'roll_rate'\?.*use one of: roll"):
        check("2 * roll_rte", ["roll", "roll_rate"])
    with pytest.raises(ModelError, match=r"no function sinn\(\).*did you mean 'sin'"):
        check("sinn(roll)", ["roll"])
    with pytest.raises(ModelError, match="'roll roll' is not an expression at character 6"):
        check("roll roll", ["roll"])
    with pytest.raises(ModelError, match=r"write a number"):
        check("roll", [])


def test_names_in_omits_functions_and_constants() -> None:
    assert names_in("sin(pi * x) + drag.size - max(y, 2)") == {"x", "y", "drag.size"}


def test_value_is_finite_or_an_error() -> None:
    assert number(3, {}) == 3.0
    with pytest.raises(ModelError, match="has no value"):
        number("1 / x", {"x": 0.0})
    with pytest.raises(ModelError, match="has no value"):
        number("exp(x)", {"x": 1e4})
    with pytest.raises(ModelError, match="is inf"):
        number("x * 1e300", {"x": 1e300})


@pytest.mark.parametrize(
    ("text", "replacements", "wanted"),
    [
        ("-torque * rate", {"torque": "drag.torque", "rate": "roll_rate"}, "-drag.torque * roll_rate"),
        ("a * b", {"a": "x + y", "b": "-z"}, "(x + y) * -z"),
        ("a ** 2 / b", {"a": "x * y", "b": "x / y"}, "(x * y) ** 2 / (x / y)"),
        ("sin(a) - a", {"a": "b", "sin": "cos"}, "sin(b) - b"),
        ("a + b", {"a": "b", "b": "a"}, "b + a"),
        ("drag.torque + torque", {"torque": "t", "drag": "u"}, "drag.torque + t"),
        ("2 * size", {"size": "drag@trim.size"}, "2 * drag@trim.size"),
        ("x\n  + y", {"z": "a"}, "x + y"),
    ],
)
def test_renaming_preserves_the_meaning(text: str, replacements: dict[str, str], wanted: str) -> None:
    assert renamed(text, replacements) == wanted


def test_length_counts_terms_with_the_definitions_substituted() -> None:
    assert length("x + sin(y)", {}) == 4
    lengths: dict[str, int] = {}
    for step in range(60):
        lengths[f"d{step + 1}"] = length(f"d{step} * d{step}", lengths)
    assert lengths["d60"] > 10**18  # counted without being expanded


@pytest.mark.parametrize("name", ["time", "pi", "sin", "max", "lambda", "None", "2x", "x y", "x-y", "", "größe", "x.y"])
def test_name_problem_describes_invalid_names(name: str) -> None:
    assert name_problem(name)


@pytest.mark.parametrize("name", ["x", "roll_rate", "_", "Time", "pi2", "sinus", "e"])
def test_name_problem_is_empty_for_valid_names(name: str) -> None:
    assert not name_problem(name)


def test_every_function_has_the_same_value_in_sympy() -> None:
    for name, (arity, function) in expressions.FUNCTIONS.items():
        arguments = ["x", "y"][:arity]
        text = f"{name}({', '.join(arguments)})"
        expected = function(*[0.3, 0.7][:arity])
        assert float(parse(text, SYMBOLS).subs({X: 0.3, Y: 0.7})) == pytest.approx(expected, rel=1e-14)


@pytest.fixture
def frequent_garbage_collection() -> Iterator[None]:
    """Python collects garbage after every few objects, and each time lets another thread run."""
    before = gc.get_threshold()

    def other_thread(phase: str, info: object) -> None:
        time.sleep(0)

    gc.callbacks.append(other_thread)
    gc.set_threshold(20)
    try:
        yield
    finally:
        gc.set_threshold(*before)
        gc.callbacks.remove(other_thread)


def test_equations_can_be_read_by_two_threads_at_once(frequent_garbage_collection: None) -> None:
    """Without the lock, some of 2000 calls fail with Python 3.11.7's "AST constructor recursion depth mismatch"."""
    text = "x / (1 - x) * (y + drag.size * ((2 * pi * x) ** 2 * y + 4 * pi * x * y * drag.size))"
    with ThreadPoolExecutor(2) as pool:
        read = set(pool.map(lambda _: names_in(text), range(2000)))
    assert read == {names_in(text)}
