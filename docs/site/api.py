"""The page of the library, from its docstrings: what `upright.__all__` names, and nothing below it.

A page is a promise. The packages below `upright` may change at any time, so that they have none; the architecture and
the journey of a sample link their sources.
"""

from __future__ import annotations

import inspect

import upright

_HEAD = """\
# Python, from the docstrings

Everything in `upright.__all__`, with types, shapes, units and errors. An overview of it, and what is stable:
[Python](python.md).

```{eval-rst}
.. py:module:: upright
```

"""
_OPTIONS = ("   :members:", "   :inherited-members: Exception, BaseException, StrEnum, str", "   :show-inheritance:")


def markdown() -> str:
    """The whole page: functions, then results and what they are made of, then errors."""
    names = [name for name in upright.__all__ if not name.startswith("__")]
    functions = [name for name in names if inspect.isfunction(getattr(upright, name))]
    classes = [name for name in names if name not in functions]
    errors = [name for name in classes if issubclass(getattr(upright, name), Exception)]
    classes = [name for name in classes if name not in errors]
    groups = {"Functions": functions, "Classes": classes, "Errors and warnings": errors}
    return _HEAD + "".join(f"## {title}\n\n" + "".join(map(_entry, each)) for title, each in groups.items())


def _entry(name: str) -> str:
    function = inspect.isfunction(getattr(upright, name))
    directive = f".. auto{'function' if function else 'class'}:: upright.{name}"
    lines = [f"### `{name}`", "", "```{eval-rst}", directive, *(() if function else _OPTIONS), "```"]
    return "\n".join([*lines, "", ""])
