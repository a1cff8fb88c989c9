"""The results file: one JSON line per case, only appended to, so that an interrupted run can be resumed.

A line that was truncated by a crash is skipped when reading; of several lines with the same key the last counts.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterable, Sequence
from pathlib import Path

from upright.service.hidden_effects.cases import Case
from upright.service.hidden_effects.trial import Bench, Line, beginning
from upright.telemetry.errors import UprightError

FAILED = "failed"
"""Status of a case that could not be completed; a later run repeats it."""


class ResultsError(UprightError):
    """The results file `path` cannot be used."""

    def __init__(self, path: Path, message: str, *, remedy: str) -> None:
        super().__init__(f"{path}: {message}.", remedy=remedy)
        self.path = path


def read(path: Path) -> dict[str, Line]:
    """The lines by key, in the order of the file. Raises ResultsError if it cannot be read or is not a results file."""
    try:
        texts = path.read_bytes().splitlines()
    except OSError as error:
        remedy = "give a file that `upright benchmark hidden-effects` wrote."
        raise ResultsError(path, f"cannot be read ({error.strerror})", remedy=remedy) from error
    lines: dict[str, Line] = {}
    for number, text in enumerate(texts, start=1):
        try:
            line = json.loads(text)
        except ValueError:
            continue  # truncated, or empty
        if not (isinstance(line, dict) and isinstance(line.get("methods"), dict) and "status" in line):
            remedy = "give a file that `upright benchmark hidden-effects` wrote."
            raise ResultsError(path, f"line {number} is not a result", remedy=remedy)
        lines.pop(line["key"], None)
        lines[line["key"]] = line
    if texts and not lines:
        remedy = "give a file that `upright benchmark hidden-effects` wrote."
        raise ResultsError(path, "contains no result", remedy=remedy)
    return lines


def append(path: Path, line: Line) -> None:
    """Add `line` in one write, on a line of its own even if the previous one was truncated."""
    text = json.dumps(line, allow_nan=True).encode() + b"\n"
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("ab+") as file:
        if file.tell() > 0:
            file.seek(-1, os.SEEK_END)
            if file.read(1) != b"\n":
                text = b"\n" + text
        file.write(text)
        file.flush()
        os.fsync(file.fileno())


def left(cases: Iterable[Case], bench: Bench, lines: dict[str, Line]) -> list[Case]:
    """The cases without a line that has all methods of `bench`; a failed case is repeated."""
    return [case for case in cases if not _answered(lines.get(case.key), bench.methods)]


def check(path: Path, lines: dict[str, Line], conditions: str) -> None:
    """Raises ResultsError if a line was made under other conditions: they cannot be evaluated together."""
    for line in lines.values():
        if line.get("conditions") != conditions:
            what = f"was made with {line.get('conditions')}, and this run is with {conditions}"
            raise ResultsError(path, what, remedy="write to another file: --output.")


def _answered(line: Line | None, methods: Iterable[str]) -> bool:
    if line is None or line["status"] == FAILED:
        return False
    return line["status"] != "ok" or all(name in line["methods"] for name in methods)


def failed(case: Case, bench: Bench, reason: str) -> Line:
    """The line of a case that could not be completed."""
    return {**beginning(case, bench), "status": FAILED, "reason": reason, "methods": {}}


def methods_of(lines: Iterable[Line]) -> Sequence[str]:
    """Names of the methods in the lines, in the order of their first occurrence."""
    return list(dict.fromkeys(name for line in lines for name in line["methods"]))
