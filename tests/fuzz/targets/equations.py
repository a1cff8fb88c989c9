"""Equations as text, through everything that reads them."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import sympy
from hypothesis import strategies as st

from fuzz.mutation import mutated
from fuzz.target import Target, Trial
from upright.models.text import expressions

VALUES = {"x": 0.5, "y": 2.0, "roll": 0.1, "roll_rate": 0.2, "drag.size": 7.0}
SYMBOLS = {name: sympy.Symbol(name, real=True) for name in VALUES}
WORDS = (
    *("x", "y", "roll", "roll_rate", "drag.size", "pi", "time", "sin(", "cos(", "exp(", "log(", "sqrt(", "min("),
    *("max(", "abs(", "sign(", ")", ")", "(", "(", "+", "-", "*", "/", "**", "**", ",", ".", "9", "16", "-1", "0", "2"),
    *("17", "1e308", "1e-308", "0x10", "1_0", "1j", "True", "None", "__class__", "__import__('os')", "lambda", "["),
    *("]", "{", "}", ":", ";", '"', "'", "#", "\\", "½", "ａ", "é", "𝑥", "²", "and", "or", "not", "if", "else", "for"),
    *("in", "is", "~", "%", "//", "@", ":=", "f'{x}'", "...", "_"),
)
TOWERS = (
    "9**9**9",
    "9**9**9**9",
    "(((((9**16)**16)**16)**16)**16)",
    "x**x**x**x**x",
    "exp(exp(exp(exp(x))))",
    "(x+1)**16**1",
    "((x+y)**16+1)**16",
    "(((x+y)**16+1)**16+1)**16",
    "tan(tan(tan(tan(x))))",
    "pi**pi**pi",
    "max(x, y)**16",
    "abs(x)**0.5",
    "(-8)**(1/3)",
    "x/(y-y)",
    "sqrt(x - x - 1)",
    "*".join(["(x+1)**16"] * 200),
    "+".join(["sin(x)"] * 600),
    "(" * 99 + "x" + ")" * 99,
    "-" * 3900 + "x",
    "x" + "**2" * 1000,
    "sin(" * 100 + "x" + ")" * 100,
    "min(" * 90 + "x" + ",1)" * 90,
    "1" * 4000,
    "0." + "1" * 3900,
    "sin.__globals__",
    "().__class__.__bases__[0].__subclasses__()",
    "2 * sin(roll) ** 2 - drag.size * roll_rate * abs(roll_rate)",
)


def inputs() -> st.SearchStrategy[bytes]:
    words = st.lists(st.sampled_from([*WORDS, *(f"{word} " for word in WORDS)]), min_size=1, max_size=80).map("".join)
    return st.one_of(
        words.map(str.encode),
        mutated([each.encode() for each in TOWERS], [word.encode() for word in WORDS]),
        grown().map(str.encode),
        st.text(max_size=60).map(lambda text: text.encode(errors="surrogatepass")),
    )


def grown() -> st.SearchStrategy[str]:
    """Expressions that are correct, and grow as they please."""
    leaves = st.sampled_from(["x", "y", "roll", "drag.size", "pi", "2", "0", "16", "0.5", "1e300", "(x - x)"])

    def more(inner: st.SearchStrategy[str]) -> st.SearchStrategy[str]:
        functions = st.sampled_from(["sin", "cos", "tan", "exp", "log", "sqrt", "abs", "sign", "tanh", "sinh", "asin"])
        return st.one_of(
            st.tuples(inner, st.sampled_from(["+", "-", "*", "/", "**"]), inner).map(
                lambda each: "({} {} {})".format(*each)
            ),
            st.tuples(functions, inner).map(lambda each: "{}({})".format(*each)),
            st.tuples(st.sampled_from(["min", "max"]), inner, inner).map(lambda each: "{}({}, {})".format(*each)),
        )

    return st.recursive(leaves, more, max_leaves=25)


@contextmanager
def opened(folder: Path) -> Iterator[Trial]:
    def trial(data: bytes) -> None:
        text = data.decode(errors="replace")
        expressions.check(text, VALUES)
        expressions.names_in(text)
        expressions.length(text, {"x": 5})
        expressions.renamed(text, {"x": "y + 1"})
        expression = expressions.parse(text, SYMBOLS)
        assert isinstance(expression, sympy.Basic)
        expressions.number(text, VALUES)

    yield trial


TARGETS = (
    Target("expression", "an equation of a model file", opened, inputs, lambda: [each.encode() for each in TOWERS]),
)
