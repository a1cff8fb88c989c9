"""How a user states what a recording does not: at the terminal by options, `--assume angle=deg`, in Python by
arguments, `assume={"angle": "deg"}`.

A remedy names what the user who gets it can write: `in_python` is entered by the functions of the library.
"""

from __future__ import annotations

import json
import shlex
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from contextvars import ContextVar

_PYTHON: ContextVar[bool] = ContextVar("in_python", default=False)

Stated = str | Sequence[str]
"""What is stated of a channel, or several such statements."""


@contextmanager
def in_python() -> Iterator[None]:
    """Within this block, or in the function that it decorates, remedies name arguments instead of options."""
    before = _PYTHON.set(True)
    try:
        yield
    finally:
        _PYTHON.reset(before)


def option(terminal: str, python: str) -> str:
    """The one of the two that the user can write."""
    return python if _PYTHON.get() else terminal


def mapped(columns: Mapping[str, str]) -> str:
    """The option that gives the columns of channels."""
    return _stated("--map", "columns", columns)


def assumed(units: Mapping[str, Stated]) -> str:
    """The option that gives the units of channels, or how else they are written."""
    return _stated("--assume", "assume", units)


def statements(given: Mapping[str, Stated] | None) -> list[str]:
    """What an argument of Python states, as the texts of the option."""
    return [f"{channel}={text}" for channel, text in _each(given or {})]


def _stated(name: str, argument: str, given: Mapping[str, Stated]) -> str:
    options = " ".join(f"{name} {channel}={shlex.quote(text)}" for channel, text in _each(given))
    arguments = {
        channel: stated[0] if not isinstance(stated, str) and len(stated) == 1 else stated
        for channel, stated in given.items()
    }
    return option(options, f"{argument}={json.dumps(arguments, ensure_ascii=False)}")


def _each(given: Mapping[str, Stated]) -> Iterator[tuple[str, str]]:
    for channel, stated in given.items():
        for text in [stated] if isinstance(stated, str) else stated:
            yield channel, text
