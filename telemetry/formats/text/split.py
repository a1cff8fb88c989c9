"""Lines of text as rows of fields: the separator, quotes, and fields with a label of their own (`angle:0.12`)."""

from __future__ import annotations

import csv
import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from upright.telemetry.documents import from_json
from upright.telemetry.errors import RecordingError
from upright.telemetry.formats.text.fields import Decimal, decimal_of, is_hole, is_number

SAMPLE = 60
"""Lines that are looked at to find the separator: from the second half of a file, where there is no heading."""
SEPARATORS = (",", ";", "\t", "|", " ")
RULES = frozenset("-=+:|,; \t")
"""Characters of a line that separates, as of Markdown."""
_WORDS = {",": "comma", ";": "semicolon", "\t": "tab", "|": "vertical bar", " ": "spaces"}
_LABELLED = re.compile(r"\s*(?P<label>[A-Za-z_][\w./ \[\]-]*?)\s*[:=]\s*(?P<value>[-+]?[\d.][^:=]*|nan|NaN)\s*$")


@dataclass(frozen=True, slots=True)
class Row:
    """The `fields` of line number `line`, 1 for the first."""

    line: int
    fields: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Rows:
    """All rows that are not blank, how they were `separator`-ated, how numbers are written, and what was assumed."""

    rows: tuple[Row, ...]
    separator: str
    decimal: Decimal
    said: tuple[str, ...]


def rows_of(text: str, source: str) -> Rows:
    """Split `text`. Raises RecordingError for text that is no table."""
    lines = text.split("\n")
    said: list[str] = []
    first, given = 0, ""
    if (lines and (found := re.match(r'"?sep=(.)"?$', lines[0].strip("\ufeff \t"), re.IGNORECASE))) or (
        lines and lines[0].strip() == "sep="
    ):
        given, first = found[1] if found else "\t", 1
    filled = _filled(lines, first)
    if not filled:
        raise RecordingError(source, "", "holds no rows", remedy="Record again, for longer.")
    lines, labelled = _bare(lines, filled)
    filled = _filled(lines, first)
    half = filled[len(filled) // 2 :] if len(filled) > 2 * 4 else filled
    sample = [lines[number] for number in half[:SAMPLE]]
    separator = given or _separator(sample)
    quoted = any('"' in line for line in (*sample, lines[filled[0]]))
    rows = [Row(number + 1, fields) for number, fields in _fields(lines, filled, separator, quoted, source)]
    labels = () if labelled else _labels(rows)
    if labelled:
        rows = [Row(0, labelled), *rows]
        said.append(f"fields: JSON in each line ({', '.join(labelled)})")
    if labels:
        rows = [Row(0, labels), *(_unlabelled(row, labels) for row in rows)]
        said.append(f"fields: labelled in each line ({', '.join(labels)})")
    head = rows[-min(len(rows), SAMPLE) :]
    decimal = decimal_of([each for row in head for each in row.fields], separator)
    if separator != ",":
        said.append(f"separator: {_WORDS.get(separator, repr(separator))}")
    if decimal.mark != ".":
        said.append("decimal mark: comma")
    if decimal.group:
        said.append(f"thousands are grouped by {decimal.group!r}")
    if quoted and '"' in lines[half[0]]:
        said.append("fields in quotes")
    return Rows(tuple(rows), separator, decimal, tuple(said))


def _filled(lines: Sequence[str], first: int) -> list[int]:
    """The lines that are not blank."""
    return [number for number in range(first, len(lines)) if lines[number].strip(" \t,;|\x1a\x1b")]


def _bare(lines: Sequence[str], filled: Sequence[int]) -> tuple[list[str], tuple[str, ...]]:
    """Lines without brackets around them and without rulers; those of JSON objects as fields, with their labels."""
    found = ["" if line[:1] in RULES and not set(line) - RULES else line for line in lines]
    filled = [number for number in filled if found[number].strip()]
    ends = {(found[number].strip()[0], found[number].strip()[-1]) for number in filled}
    if ends <= {("[", "]"), ("(", ")")}:
        return [line.strip()[1:-1] for line in found], ()
    if ends != {("{", "}")}:
        return found, ()
    try:
        objects = {number: _flat(from_json(found[number])) for number in filled}
    except ValueError:
        return found, ()
    labels = tuple(dict.fromkeys(label for each in objects.values() for label in each))
    for number, each in objects.items():
        found[number] = "\t".join(each.get(label, "") for label in labels)
    return found, labels if len(labels) > 1 else ()


def _flat(value: Any, path: str = "") -> dict[str, str]:
    """The numbers and texts of a JSON object, by their paths."""
    if isinstance(value, dict):
        return {
            name: text for key, each in value.items() for name, text in _flat(each, f"{path}/{key}".lstrip("/")).items()
        }
    if value is None or isinstance(value, list):
        return {path: ""}
    return {path: str(value).replace("\t", " ").replace("\n", " ")}


def split_line(line: str, separator: str) -> tuple[str, ...]:
    """One line, by `separator`."""
    if separator == " ":
        return tuple(line.split())
    try:
        return tuple(next(csv.reader([line], delimiter=separator, skipinitialspace=True), ()))
    except csv.Error:
        return tuple(line.split(separator))


def _separator(sample: Sequence[str]) -> str:
    """The separator with which most fields are numbers; among equals, the one that gives most lines as many."""
    best, found = (-1.0, -1.0, 0.0), ","
    for separator in SEPARATORS:
        rows = [split_line(line, separator) for line in sample]
        size, agree = Counter(map(len, rows)).most_common(1)[0]
        if size < 2:
            continue
        fields = [each.strip() for row in rows for each in row]
        decimal = decimal_of(fields, separator)
        # Of labelled fields, what is after the label counts.
        values = [match["value"] if (match := _LABELLED.match(each)) else each for each in fields]
        known = [each for each in values if not is_hole(each)]
        share = sum(is_number(each, decimal) for each in known) / max(len(known), 1)
        score = (round(share, 2), agree / len(rows), -float(SEPARATORS.index(separator)))
        if score > best:
            best, found = score, separator
    return found


def _fields(
    lines: Sequence[str], filled: Sequence[int], separator: str, quoted: bool, source: str
) -> list[tuple[int, tuple[str, ...]]]:
    if separator == " ":
        return [(number, tuple(lines[number].replace('"', "").split())) for number in filled]
    if not quoted:
        return [(number, tuple(lines[number].split(separator))) for number in filled]
    chosen = [lines[number] for number in filled]
    # A quote that is never closed would swallow the rest: then each line is split by itself.
    reader = csv.reader(chosen, delimiter=separator, skipinitialspace=True)
    found: list[tuple[int, tuple[str, ...]]] = []
    try:
        before = 0
        for fields in reader:
            if reader.line_num - before > 1 and len(found) > 0:
                break
            found.append((filled[before], tuple(fields)))
            before = reader.line_num
        else:
            return found
    except csv.Error:
        pass
    return [(number, split_line(lines[number], separator)) for number in filled]


def _labels(rows: Sequence[Row]) -> tuple[str, ...]:
    """The labels if most fields of most rows have one; () otherwise."""
    sample = rows[len(rows) // 2 :][:SAMPLE]
    found = [tuple(match["label"] for each in row.fields if (match := _LABELLED.match(each))) for row in sample]
    labels, count = Counter(found).most_common(1)[0]
    return labels if len(labels) > 1 and 2 * count > len(sample) else ()


def _unlabelled(row: Row, labels: Sequence[str]) -> Row:
    found = {match["label"]: match["value"] for each in row.fields if (match := _LABELLED.match(each))}
    return Row(row.line, tuple(found.get(label, "") for label in labels))
