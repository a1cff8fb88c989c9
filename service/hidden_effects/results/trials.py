"""The results file: one JSON line a case, only ever appended to, so that a run that was ended goes on where it was.

A line that was cut off by a crash is passed over when reading; of several lines of one key the last counts.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterable, Sequence
from pathlib import Path

from service.hidden_effects.cases import Case
from service.hidden_effects.trial import Bench, Line, beginning
from telemetry.errors import UprightError

FAILED = "failed"
"""Status of a case that could not be run to its end; a later run takes it up again."""


class ResultsError(UprightError):
    """A results file cannot be used. `path` says which."""

    def __init__(self, path: Path, message: str, *, remedy: str) -> None:
        super().__init__(f"{path}: {message}.", remedy=remedy)
        self.path = path


def read(path: Path) -> dict[str, Line]:
    """Key to line, in the order of the file. Raises ResultsError where it cannot be read or holds something else."""
    try:
        texts = path.read_bytes().splitlines()
    except OSError as error:
        remedy = "name a file that `upright benchmark hidden-effects` wrote."
        raise ResultsError(path, f"cannot be read ({error.strerror})", remedy=remedy) from error
    lines: dict[str, Line] = {}
    for number, text in enumerate(texts, start=1):
        try:
            line = json.loads(text)
        except ValueError:
            continue  # cut off, or empty
        if not (isinstance(line, dict) and isinstance(line.get("methods"), dict) and "status" in line):
            remedy = "name a file that `upright benchmark hidden-effects` wrote."
            raise ResultsError(path, f"line {number} is no result", remedy=remedy)
        lines.pop(line["key"], None)
        lines[line["key"]] = line
    if texts and not lines:
        remedy = "name a file that `upright benchmark hidden-effects` wrote."
        raise ResultsError(path, "holds no result", remedy=remedy)
    return lines


def append(path: Path, line: Line) -> None:
    """Add `line` in one write, on a line of its own even where the one before was cut off."""
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
    """The cases that `lines` do not answer for every method of `bench`; one that failed is asked again."""
    return [case for case in cases if not _answered(lines.get(case.key), bench.methods)]


def check(path: Path, lines: dict[str, Line], conditions: str) -> None:
    """Raises ResultsError where a line was made under other conditions: they cannot be told together."""
    for line in lines.values():
        if line.get("conditions") != conditions:
            what = f"was made with {line.get('conditions')}, and this run is with {conditions}"
            raise ResultsError(path, what, remedy="write to another file: --output.")


def _answered(line: Line | None, methods: Iterable[str]) -> bool:
    if line is None or line["status"] == FAILED:
        return False
    return line["status"] != "ok" or all(name in line["methods"] for name in methods)


def failed(case: Case, bench: Bench, reason: str) -> Line:
    """The line of a case that could not be run to its end."""
    return {**beginning(case, bench), "status": FAILED, "reason": reason, "methods": {}}


def methods_of(lines: Iterable[Line]) -> Sequence[str]:
    """Names of the methods in the lines, in the order in which they first come."""
    return list(dict.fromkeys(name for line in lines for name in line["methods"]))
