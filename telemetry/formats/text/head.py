"""Where the numbers of a table begin, and what is said of them above: names, units, comments."""

from __future__ import annotations

import itertools
import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

from upright.telemetry.errors import RecordingError
from upright.telemetry.formats.text.fields import is_hole, is_number
from upright.telemetry.formats.text.split import Row, Rows, split_line
from upright.telemetry.tables.units import is_unit

COMMENTS = ("#", "%", "//", "!", "*", ";")
_TYPES_TEXT = "double float int long float32 float64 int32 int64 uint32 string text bool boolean datetime number"
TYPES = frozenset(_TYPES_TEXT.split())
SAMPLE = 60
FEW = 12
"""Rows up to which all of a table are looked at."""


@dataclass(frozen=True, slots=True)
class Head:
    """Headings and units (k,) of the columns, "" for none, the rows of data, and what was assumed.

    `left_out` are rows among the data that are none.
    """

    headings: tuple[str, ...]
    units: tuple[str, ...]
    data: tuple[Row, ...]
    left_out: tuple[Row, ...]
    said: tuple[str, ...]
    truncated: str = ""


def head_of(found: Rows, source: str) -> Head:
    """Tell names and units from data. Raises RecordingError if no line is data."""
    rows = list(found.rows)
    if len(rows) == 1 and not any(is_number(each, found.decimal) for each in rows[0].fields):
        raise RecordingError(source, "", "holds no rows", remedy="Record again, for longer.")
    width = _width(rows)
    if width == 1:
        what = "holds no channels: there is one column only"
        raise RecordingError(source, "", what, remedy="Give a column of time, and one of numbers for each channel.")
    least = max(2, width - _missing_at_the_end(rows, width))
    numeric = _numeric(rows, width, found)
    if not numeric:
        remedy = "Give a table with one row for each instant: a column of time, and one of numbers for each channel."
        raise RecordingError(source, "", "has no columns of numbers", remedy=remedy)

    def is_data(row: Row) -> bool:
        if len(row.fields) == width and _is_plain(row.fields[numeric[0]]):
            return True
        fields = [row.fields[place].strip() if place < len(row.fields) else "" for place in numeric]
        known = [each for each in fields if not is_hole(each)]
        good = sum(is_number(each, found.decimal) for each in known)
        return len(row.fields) >= least and good > 0 and 2 * good >= len(known)

    def begins(row: Row) -> bool:
        # In a line above, a number may stand beside its name.
        first = row.fields[numeric[0]] if numeric[0] < len(row.fields) else ""
        return is_data(row) and not _is_comment(row) and (is_hole(first) or is_number(first, found.decimal))

    begin = next((place for place, row in enumerate(rows) if begins(row)), None)
    if begin is None:
        remedy = "Give a table with one row for each instant: a column of time, and one of numbers for each channel."
        raise RecordingError(source, "", "has no rows of numbers", remedy=remedy)
    said: list[str] = []
    headings, units, used = _above(rows[:begin], width, found, said)
    above = [each for each in rows[begin - 1].fields if each.strip()] if begin else []
    if not headings and 2 * len(above) == width and not any(is_number(each, found.decimal) for each in above):
        what = f"has {len(above)} headings for {width} columns"
        remedy = "If the decimal mark is a comma, separate fields by semicolons, or put them in quotes."
        raise RecordingError(source, f"line {rows[begin].line}", what, remedy=remedy)
    comments = begin - used
    if comments:
        said.append(f"{comments} {'line' if comments == 1 else 'lines'} above the table left out")
    data, left_out, truncated = [], [], ""
    for place, row in enumerate(rows[begin:], begin):
        if is_data(row):
            data.append(row)
        elif place == len(rows) - 1 and len(row.fields) < width:
            truncated = f"line {row.line} is cut off and was left out"
        else:
            left_out.append(row)
    headings, shifted, data = _fitted(headings, data, width, source, said)
    units = ("", *units) if shifted else units
    size = len(headings)
    return Head(headings, (*units, *[""] * size)[:size], tuple(data), tuple(left_out), tuple(said), truncated)


def _is_plain(text: str) -> bool:
    """Whether a field is a plain number, as all of them are in most rows of data."""
    return text.strip("+-\"' ")[:1].isdigit() and text.strip("+-\"' ")[-1:].isdigit()


def _later(rows: Sequence[Row]) -> Sequence[Row]:
    """The second half of the rows, where there is no heading; all of them if they are few."""
    return rows[len(rows) // 2 :] if len(rows) > FEW else rows


def _width(rows: Sequence[Row]) -> int:
    """The number of fields of most rows in the second half of the file."""
    half = _later(rows)[: 10 * SAMPLE]
    return Counter(len(row.fields) for row in half).most_common(1)[0][0]


def _missing_at_the_end(rows: Sequence[Row], width: int) -> int:
    """How many fields rows may lack at their end: some writers leave out what is empty there."""
    sizes = Counter(len(row.fields) for row in _later(rows)[: 10 * SAMPLE])
    usual = [size for size, count in sizes.items() if 10 * count > sum(sizes.values())]
    return max(0, width - min(usual, default=width))


def _numeric(rows: Sequence[Row], width: int, found: Rows) -> list[int]:
    """The columns of numbers."""
    half = _later(rows)
    half = half[:: max(1, len(half) // (2 * SAMPLE))]
    places = []
    for place in range(width):
        known = [row.fields[place].strip() for row in half if place < len(row.fields)]
        known = [each for each in known if not is_hole(each)]
        if known and 2 * sum(is_number(each, found.decimal) for each in known) >= len(known):
            places.append(place)
    return places


def _is_comment(row: Row) -> bool:
    return row.fields[0].lstrip(" \"'").startswith(COMMENTS[:3])


def _above(
    rows: Sequence[Row], width: int, found: Rows, said: list[str]
) -> tuple[tuple[str, ...], tuple[str, ...], int]:
    """Headings and units from the rows above the data, and how many rows these are."""
    candidates = [fields for row in rows if (fields := _heading(row, width, found.separator))]
    candidates = [each for each in candidates if not {field.lower() for field in each if field} <= TYPES]
    if not candidates:
        return (), (), 0
    units = [place for place, each in enumerate(candidates) if _is_units(each, found)]
    if units and (names := [place for place in range(len(candidates)) if place not in units]):
        at = units[-1]
        before = [place for place in names if place < at]
        name = before[-1] if before else names[0]
        said.append(f"units from a row of their own: {', '.join(filter(None, candidates[at]))}")
        return candidates[name], tuple(each.strip("[](){} ") for each in candidates[at]), 2
    return candidates[-1], (), 1


def _heading(row: Row, width: int, separator: str) -> tuple[str, ...]:
    """The fields of a row that may be headings, () if it is none: a comment sign before them is left out."""
    fields = [each.strip().strip("\"'") for each in row.fields]
    commented = next((sign for sign in COMMENTS if fields[0].startswith(sign)), "")
    if commented:
        # A column of ROS is called %time.
        fields[0] = fields[0][len(commented) :].strip() if fields[0] != commented else ""
        if not fields[0] and len(fields) == width + 1:
            fields = fields[1:]
        if abs(len(fields) - width) > 1:
            line = separator.join(fields)
            for other in (",", ";", "\t", " "):
                split = split_line(line.strip(), other)
                if abs(len(split) - width) <= 1:
                    fields = [each.strip() for each in split]
                    break
    while len(fields) > width and not fields[-1]:
        fields.pop()
    if not (width - 1 <= len(fields) <= width) or sum(bool(each) for each in fields) < max(1, min(2, width - 1)):
        return ()
    return tuple(fields)


def _is_units(fields: Sequence[str], found: Rows) -> bool:
    """Whether the words of a row are units: all of them, or most of them if there are several."""
    filled = [each for each in fields if each.strip() and (is_unit(each) or not is_number(each, found.decimal))]
    enclosed = [each for each in filled if re.fullmatch(r"[\[(].*[\])]", each.strip())]
    known = [each for each in filled if is_unit(each)]
    return (bool(filled) and (len(known) == len(filled) or (len(enclosed) == len(filled) and bool(known)))) or (
        len(filled) > 2 and 2 * len(known) > len(filled) and all(len(each) < 12 for each in filled)
    )


def _fitted(
    headings: tuple[str, ...], data: list[Row], width: int, source: str, said: list[str]
) -> tuple[tuple[str, ...], bool, list[Row]]:
    """Headings, one for each column; whether they were shifted by one; and the rows, cut to as many fields."""
    if not headings:
        said.append("no headings: the columns are called column1, column2, ...")
        return tuple(f"column{place + 1}" for place in range(width)), False, data
    longer = [
        row for row in data if len(row.fields) > len(headings) and any(map(str.strip, row.fields[len(headings) :]))
    ]
    if not longer:
        return headings, False, data
    if 2 * len(longer) > len(data):
        counts = [row.fields[0].strip() for row in data[:SAMPLE]]
        if len(headings) == width - 1 and counts_up(counts):
            return ("", *headings), True, data
        what = f"has {len(headings)} headings for {width} columns"
        remedy = "Give each column one heading; if the decimal mark is a comma, separate by semicolons."
        raise RecordingError(source, f"line {data[0].line}", what, remedy=remedy)
    return headings, False, [row for row in data if row not in longer]


def counts_up(fields: Sequence[str]) -> bool:
    """Whether fields are whole numbers, each one more than that before."""
    try:
        whole = [int(each.strip('"')) for each in fields]
    except ValueError:
        return False
    return len(whole) > 1 and all(b - a == 1 for a, b in itertools.pairwise(whole))
