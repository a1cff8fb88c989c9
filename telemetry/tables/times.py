"""Which column is time, and in which unit."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from upright.telemetry.errors import RecordingError
from upright.telemetry.options import assumed, mapped
from upright.telemetry.recording import FARTHEST
from upright.telemetry.tables.mapping import ROW, Said, factor_of
from upright.telemetry.tables.raw import Column, RawTable
from upright.telemetry.tables.units import Unit, unit_of

_NAMES_TEXT = (
    "timestamp_ns time __time t timestamp time_stamp _time datetime date_time elapsed elapsed_time"
    " time_elapsed rel_time relative_time seconds second secs sec s millis micros millisec milliseconds"
    " microseconds nanoseconds ms us ns timestamp_s time_boot_ms timeus rosbagtimestamp x_value x-value x"
    " tout zeit zeitstempel uhrzeit temps tiempo tempo stamp ts clock tick ticks systime utc"
    " gps_time gps_tow tow epoch uptime runtime datenum date"
)
NAMES = tuple(_NAMES_TEXT.split())
"""Names of columns of time, in lower case; the first of them that a table has, if several are as fine."""
_WORDS = {"ms": "millis milliseconds millisec time_boot_ms", "us": "micros timeus microseconds", "ns": "nanoseconds"}
IN_NAMES = {word: unit for unit, words in _WORDS.items() for word in words.split()} | {"timestamp_ns": "ns"}
"""Names of columns of time that state their unit."""
EPOCH = (946_684_800.0, 4_102_444_800.0)
"""s since 1970: the years 2000 to 2100."""
DAY = 86_400.0
"""s."""
DAYS = ((36_526.0, 73_050.0), (730_486.0, 767_010.0))
"""The same in days as Excel and MATLAB count them."""
_MILLI = ("ms", "msec", "millis", "millisecond", "milliseconds")
SAME_NS = 1000
"""Between two columns that count the same instants, of which one is rounded."""
_SECONDS, _PARTS = ("sec", "secs", "seconds"), {"nsec": 1, "nsecs": 1, "nanosec": 1, "nanoseconds": 1, "usec": 1000}


@dataclass(frozen=True, slots=True)
class Times:
    """The time stamps of the rows: int64 ns (n,), `known` bool (n,). `columns` are the headings that they came from;
    `resolution` s is the step of the unit they were counted in, 0 if that is not known; `daily`: a time of day, which
    begins anew at midnight. `said` states what was assumed."""

    ns: NDArray[np.int64]
    known: NDArray[np.bool_]
    columns: tuple[str, ...]
    resolution: float
    daily: bool
    said: str


def times_of(table: RawTable, user: Said) -> Times:
    """The time of each row. Raises RecordingError if no column is time."""
    found = _times(table, user)
    same = [each.heading for each in table.columns if each.heading not in found.columns and _is_same(each, found)]
    return replace(found, columns=(*found.columns, *same))


def _is_same(column: Column, times: Times) -> bool:
    """Whether a column of another name counts the same instants, from any beginning."""
    if not is_time_name(column.name) or column.kind != "number" or not len(column.values) or not times.known.all():
        return False
    since = (column.values - column.values[0]) * _unit(column, "")[0].factor * 1e9
    return bool(np.all(np.abs(since - (times.ns - times.ns[0])) <= SAME_NS))


def _times(table: RawTable, user: Said) -> Times:
    asked, assumed = user.columns.get("time"), user.assumed.get("time")
    stated = (assumed.unit if assumed else "") or (asked.unit if asked else "")
    if asked and asked.column == ROW:
        spacing = factor_of(stated or "1")
        step = 1e9 * abs(spacing.factor) if spacing else 1e9
        ns = np.round(np.arange(len(table)) * step).astype(np.int64)
        return Times(
            ns, np.ones(len(table), bool), (), 0.0, False, f"time: {step * 1e-9:g} s from row to row, as stated"
        )
    column = _asked(table, asked.column) if asked else _chosen(table)
    parts = _seconds_and_parts(table, column)
    if parts is not None and not stated:
        return parts
    if (whole := _seconds_and_milliseconds(table, column)) is not None and not stated:
        return whole
    if column.kind in ("date", "time of day"):
        exact = column.exact if column.exact is not None else np.nan_to_num(column.values).astype(np.int64)
        said = f"time: column {column.heading}, {'dates' if column.kind == 'date' else 'times of day'}"
        return Times(exact, np.isfinite(column.values), (column.heading,), 0.0, column.kind == "time of day", said)
    unit, why = _unit(column, stated)
    return _scaled(column, unit, why, table.source)


def is_time_name(name: str) -> bool:
    """Whether a column of that name is one of time."""
    return _rank(name) is not None


def _rank(name: str) -> int | None:
    bare = re.sub(r"[\s_]+s$", "", name.strip().strip("%#").strip().lower())
    for each in (bare, bare.replace(" ", "_"), re.split(r"[./]", bare)[-1]):
        if each in NAMES:
            return NAMES.index(each)
        words = re.split(r"[\s_.-]+", each)
        if words and (words[0] in ("time", "timestamp", "zeit") or words[-1] in ("time", "timestamp", "zeit", "stamp")):
            return len(NAMES)
    return None


def _asked(table: RawTable, name: str) -> Column:
    for column in table.columns:
        if name in (column.heading, column.name):
            return column
    for column in table.columns:
        if name.lower() in (column.heading.lower(), column.name.lower()):
            return column
    there = ", ".join(each.heading for each in table.columns)
    what = f"there is no column {name!r}; there are {there}"
    raise RecordingError(table.source, "time", what, remedy=f"Name one of these: {mapped({'time': 'COLUMN:s'})}.")


def _chosen(table: RawTable) -> Column:
    """The column of time, by its name, or by its dates, or as the first one that rises steadily."""
    found = [(rank, column) for column in table.columns if (rank := _rank(column.name)) is not None]
    found += [(rank, each) for each in table.columns if (rank := _rank(each.heading)) is not None]
    found += [(len(NAMES) + 1, column) for column in table.columns if column.kind in ("date", "time of day")]
    usable = [(rank, column) for rank, column in found if _is_counting(column)]
    if usable:
        # Beside a date there is often a finer time; among equals the better name wins.
        finest = max(_distinct(column) for _, column in usable)
        return min((each for each in usable if 1.05 * _distinct(each[1]) >= finest), key=lambda each: each[0])[1]
    first = table.columns[0]
    counted = first.exact is not None and np.all(np.diff(first.exact) == 1)
    if first.name.startswith("column") and _rises(first) and not counted:
        return first
    there = ", ".join(each.heading for each in table.columns)
    name, count = mapped({"time": "COLUMN:s"}), mapped({"time": "row:0.01"})
    remedy = f"Name it: {name} (or ms, us); if the rows are evenly spaced, {count} for 0.01 s."
    key = found[0][1].heading if found else "time"
    what = "does not rise: it is no column of time" if found else f"is missing from the header; there are {there}"
    raise RecordingError(table.source, key, what, remedy=remedy)


def _is_counting(column: Column) -> bool:
    """Whether most steps have the same sign: a clock that is set back, or a table in reverse, is one still."""
    steps = np.diff(column.values[np.isfinite(column.values)])
    if len(steps) == 0:
        return True
    rising, falling = np.count_nonzero(steps > 0.0), np.count_nonzero(steps < 0.0)
    return bool(max(rising, falling) > 3 * min(rising, falling)) or len(steps) < 4


def _distinct(column: Column) -> int:
    return len(np.unique(column.values[np.isfinite(column.values)]))


def _rises(column: Column) -> bool:
    steps = np.diff(column.values)
    return bool(len(steps) and np.all(steps > 0.0) and np.max(steps) < 10.0 * np.median(steps))


def _unit(column: Column, stated: str) -> tuple[Unit, str]:
    """The unit of time, and why."""
    if stated and (given := factor_of(stated)):
        return Unit("s", given.factor), f"in {stated}, as stated"
    if (found := unit_of(column.unit)) and found.si == "s":
        where = "its heading" if column.unit in column.heading else "the file"
        return found, "" if found.factor == 1.0 else f"in {column.unit}, as {where} states"
    words = re.split(r"[\s_./%-]+", column.heading.lower())
    for word in (column.heading.lower().strip("%"), words[-1]):
        name = IN_NAMES.get(word, word if word in ("ms", "us", "ns", "s", "sec", "secs", "seconds", "min") else "")
        if name and (found := unit_of(name)):
            return found, "" if found.factor == 1.0 else f"in {name}, by its name"
    known = np.abs(column.values[np.isfinite(column.values)])
    middle = float(np.median(known)) if len(known) else 0.0
    if "date" in column.heading.lower() and any(begin < middle < end for begin, end in DAYS):
        return Unit("s", DAY), "in days, by its name and its size"
    for factor, name in ((1.0, "s"), (1e-3, "ms"), (1e-6, "us"), (1e-9, "ns")):
        if EPOCH[0] < middle * factor < EPOCH[1]:
            return Unit("s", factor), f"in {name} since 1970, by its size"
    return Unit("s", 1.0), "in s, since no unit is stated"


def _scaled(column: Column, unit: Unit, why: str, source: str) -> Times:
    known = np.isfinite(column.values)
    factor = 1e9 * unit.factor
    whole = abs(factor - round(factor)) < 1e-9 and factor >= 1.0
    heading = "" if column.heading == "time" else f"column {column.heading}"
    said = ", ".join(filter(None, (heading, why)))
    said = f"time: {said}" if said else ""
    if unit.factor == DAY and known.any():  # counted from an epoch of their own
        column = replace(column, values=column.values - float(np.floor(column.values[known][0])), exact=None)
    beyond = np.flatnonzero(known & ~(np.abs(column.values) < FARTHEST / factor))
    if len(beyond):
        row = int(beyond[0])
        what = f"is outside of this century, the first in row {row + 1}"
        raise RecordingError(source, "time", what, remedy=f"State its unit: {assumed({'time': 'ms'})} (or us, ns).")
    if column.exact is not None and whole:
        return Times(column.exact * round(factor), known, (column.heading,), unit.factor, False, said)
    ns = np.zeros(len(known), dtype=np.int64)
    ns[known] = np.round(column.values[known] * factor).astype(np.int64)
    return Times(ns, known, (column.heading,), unit.factor if column.exact is not None else 0.0, False, said)


def _seconds_and_milliseconds(table: RawTable, column: Column) -> Times | None:
    """A date or a time of day in whole seconds, with a column of milliseconds from 0 to 999 beside it."""
    milli = next((each for each in table.columns if each.heading.strip().lower() in _MILLI), None)
    clocks = [each for each in table.columns if each.kind in ("date", "time of day") and each.exact is not None]
    if milli is None or milli.exact is None or not clocks or not 0 <= milli.exact.min() <= milli.exact.max() < 1000:
        return None
    clock = next((each for each in clocks if each is column), None) or max(clocks, key=_distinct)
    if clock.exact is None or (clock.exact % 1_000_000_000).any():
        return None
    ns = clock.exact + 1_000_000 * milli.exact
    said = f"time: columns {clock.heading} and {milli.heading}"
    headings = (clock.heading, milli.heading)
    return Times(ns, np.ones(len(ns), bool), headings, 0.0, clock.kind == "time of day", said)


def _seconds_and_parts(table: RawTable, column: Column) -> Times | None:
    """A time in two columns, whole seconds and their parts, as of ROS."""
    stem, _, last = column.name.replace("_", ".").rpartition(".")
    for seconds in table.columns:
        at, _, name = seconds.name.replace("_", ".").rpartition(".")
        if name.lower() not in _SECONDS or seconds.exact is None or (stem and at != stem and last.lower() in _SECONDS):
            continue
        for part in table.columns:
            beside, _, word = part.name.replace("_", ".").rpartition(".")
            if beside == at and word.lower() in _PARTS and part.exact is not None:
                if column is not seconds and _distinct(column) > _distinct(seconds):
                    return None
                ns = seconds.exact * 1_000_000_000 + part.exact * _PARTS[word.lower()]
                said = f"time: columns {seconds.heading} and {part.heading}"
                return Times(ns, np.ones(len(ns), bool), (seconds.heading, part.heading), 0.0, False, said)
    return None
