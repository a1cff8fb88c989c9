"""A file of text as a raw table."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from upright.telemetry.formats.text.decoded import decoded
from upright.telemetry.formats.text.fields import Decimal, numbers
from upright.telemetry.formats.text.head import counts_up, head_of
from upright.telemetry.formats.text.split import rows_of
from upright.telemetry.tables.raw import Column, RawTable
from upright.telemetry.tables.units import name_and_unit

FEW = 40
"""Distinct texts up to which a column of text may name channels."""


def read(path: Path) -> Sequence[RawTable]:
    """One table. Raises RecordingError, OSError."""
    return (read_text(path.read_bytes(), str(path)),)


def read_text(content: bytes, source: str) -> RawTable:
    """The table in the bytes of a file. Raises RecordingError."""
    text, said = decoded(content, source)
    found = rows_of(text, source)
    head = head_of(found, source)
    said += [*found.said, *head.said]
    if head.left_out:
        first = head.left_out[0]
        shown = found.separator.join(first.fields)[:40]
        count = len(head.left_out)
        said.append(
            f"{count} {'line is' if count == 1 else 'lines are'} no data and left out: line {first.line}: {shown!r}"
        )
    fields = _columns([row.fields for row in head.data], len(head.headings))
    lines = np.array([row.line for row in head.data], dtype=np.int64)
    columns, texts = [], {}
    for place, heading in enumerate(unique(head.headings, said)):
        if _is_index(head.headings[place], fields[place]):
            said.append(f"column {place + 1} counts the rows and is left out")
            continue
        name, unit = name_and_unit(heading)
        column = _column(heading, name, head.units[place] or unit, fields[place], found.decimal, lines, said)
        if column is not None:
            columns.append(column)
        elif any(each.strip() for each in fields[place]):
            texts[heading] = tuple(each.strip() for each in fields[place])
    truncated = head.truncated
    return RawTable(source, tuple(columns), lines, texts, {}, tuple(said), truncated)


def _is_index(heading: str, fields: Sequence[str]) -> bool:
    """Whether a column without a heading of its own counts the rows, as pandas and R write it."""
    named = heading.strip() and not heading.startswith("Unnamed") and heading.lower() != "index"
    return not named and counts_up(fields)


def unique(headings: Sequence[str], said: list[str]) -> list[str]:
    """Headings without repetitions; an empty one becomes columnN."""
    names = [each.strip().strip("\"'") or f"column{place + 1}" for place, each in enumerate(headings)]
    counts, seen, found = Counter(names), Counter[str](), []
    for name in names:
        seen[name] += 1
        found.append(name if seen[name] == 1 else f"{name} ({seen[name]})")
    if repeated := [name for name, count in counts.items() if count > 1]:
        said.append(f"headings that occur several times are numbered: {', '.join(repeated)}")
    return found


def _columns(rows: Sequence[tuple[str, ...]], width: int) -> list[tuple[str, ...]]:
    if all(len(row) == width for row in rows):
        return list(zip(*rows, strict=True))
    return list(zip(*((*row, *[""] * width)[:width] for row in rows), strict=True))


def _column(
    heading: str, name: str, unit: str, fields: Sequence[str], decimal: Decimal, lines: np.ndarray, said: list[str]
) -> Column | None:
    found = numbers(fields, decimal)
    if found.kind == "text":
        if found.odd:
            said.append(f"{heading}: text, left out")
        return None
    if found.kind == "yes or no":
        said.append(f"{heading}: yes or no, read as 1 or 0")
    if found.odd:
        row, text = found.odd[0]
        count = len(found.odd)
        what = "field is no number and" if count == 1 else "fields are no numbers and"
        said.append(f"{heading}: {count} {what} not known, in line {lines[row]}: {text[:40]!r}")
    if found.sentinels:
        said.append(f"{heading}: {found.sentinels} values like -999 stand for unknown ones")
    return Column(heading, name, unit or found.unit, found.values, found.exact, found.kind)
