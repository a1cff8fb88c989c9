"""JSON and TOML that others wrote. Whatever is wrong with a document, it is a ValueError, and at once.

Python's own readers trust a document: nesting exhausts the stack of both, and a dotted key of n parts costs tomllib n^2
time and memory.
"""

from __future__ import annotations

import json
import re
import tomllib
from typing import Any

DEEPEST = 100
"""Parts of a dotted key."""
_DEEP_KEY = re.compile(
    r"""(?<![\w-])(?:(?:[\w-]++|"[^"\\\n]*+"|'[^'\n]*+')[ \t]*+\.[ \t]*+){%d}""" % DEEPEST  # noqa: UP031 - braces
)


def from_json(text: str | bytes | memoryview) -> Any:
    """The value of a JSON document. Raises ValueError."""
    try:
        return json.loads(bytes(text) if isinstance(text, memoryview) else text)
    except RecursionError as error:
        raise ValueError("it is nested too deeply") from error


def from_toml(text: str) -> dict[str, Any]:
    """The tables of a TOML document. Raises ValueError."""
    if found := _DEEP_KEY.search(text):
        line = text.count("\n", 0, found.start()) + 1
        raise ValueError(f"a name of more than {DEEPEST} parts (at line {line})")
    try:
        return tomllib.loads(text)
    except RecursionError as error:
        raise ValueError("it is nested too deeply") from error
