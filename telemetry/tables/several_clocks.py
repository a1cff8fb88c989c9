"""Tables in which channels have a column of time of their own (`Time, Ch1, Time, Ch2`), or a row for each value
(`time, name, value`), and files of several tables, each with a clock of its own."""

from __future__ import annotations

import itertools
import re
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from upright.telemetry.errors import RecordingError
from upright.telemetry.options import mapped
from upright.telemetry.tables.mapping import Said
from upright.telemetry.tables.matched import may_be
from upright.telemetry.tables.raw import Column, RawTable
from upright.telemetry.tables.times import is_time_name
from upright.telemetry.tables.units import unit_of
from upright.telemetry.tables.wanted import Wanted

MOST_CELLS = 100_000_000
"""Values of a table up to which topics at different instants are one: 0.8 GB."""
VALUES = ("value", "_value", "values", "val", "data", "wert")


def with_one_clock(table: RawTable, wanted: Sequence[Wanted]) -> RawTable:
    """The table with one column of time; a value is known in rows of its own where clocks differ."""
    return _of_clocks(_of_names(table, wanted))


def _of_clocks(table: RawTable) -> RawTable:
    bare = [re.sub(r"\s\(\d+\)$", "", column.heading).strip().lower() for column in table.columns]
    places = [
        place
        for place, name in enumerate(bare)
        if bare.count(name) > 1 and is_time_name(table.columns[place].name.split(" (")[0])
    ]
    if len(places) < 2 or places[0] != 0 or any(b - a < 2 for a, b in itertools.pairwise(places)):
        return table
    clocks = [table.columns[place] for place in places]
    if all(np.array_equal(each.values, clocks[0].values, equal_nan=True) for each in clocks):
        kept = tuple(column for place, column in enumerate(table.columns) if place not in places[1:])
        return replace(table, columns=kept, said=(*table.said, "time: one column of several that are the same"))
    ends = [*places[1:], len(table.columns)]
    groups = [(clock, table.columns[begin + 1 : end]) for clock, begin, end in zip(clocks, places, ends, strict=True)]
    columns, rows = _on_one_clock(groups)
    said = f"time: {len(clocks)} columns of time, one for each group of channels"
    return replace(table, columns=columns, lines=table.lines[rows], texts={}, said=(*table.said, said))


def joined(tables: Sequence[RawTable], wanted: Sequence[Wanted], user: Said) -> RawTable:
    """The tables of a file as one, with their columns of time (the first of each) as one.

    If channels are asked for, only the tables that may have one of them are taken, and all if none has. Raises
    RecordingError if the whole would be too large.
    """
    if len(tables) == 1:
        return tables[0]
    names = {*(each.name for each in wanted), *user.columns, *user.assumed} - {"time"}
    names = {user.columns[name].column if name in user.columns else name for name in names}
    taken = [table for table in tables if any(may_be(each, name) for each in table.columns[1:] for name in names)]
    taken = taken or list(tables)
    if len(taken) == 1:
        return _with_metadata(taken[0], tables)
    clocks = _in_one_unit([table.columns[0] for table in taken])
    groups = [(clock, table.columns[1:]) for clock, table in zip(clocks, taken, strict=True)]
    cells = sum(len(table) for table in taken) * sum(len(columns) for _, columns in groups)
    if cells > MOST_CELLS:
        what = f"holds {len(taken)} topics that make {cells:.3g} values at the instants of all"
        first = next(iter(groups[0][1])).heading
        remedy = f"Name the channels that you need: {mapped({'CHANNEL': first})}."
        raise RecordingError(taken[0].source, "", what, remedy=remedy)
    columns, rows = _on_one_clock(groups)
    said = dict.fromkeys(text for table in taken for text in table.said)
    whole = RawTable(taken[0].source, columns, np.arange(1, len(rows) + 1, dtype=np.int64), said=tuple(said))
    return _with_metadata(whole, tables)


def _with_metadata(table: RawTable, tables: Sequence[RawTable]) -> RawTable:
    """With what any of the file's `tables` knows of the file."""
    metadata = {key: text for each in tables for key, text in each.metadata.items()}
    truncated = dict.fromkeys(each.truncated for each in tables if each.truncated)
    return replace(table, metadata=metadata, truncated="; ".join(truncated))


def _in_one_unit(clocks: Sequence[Column]) -> Sequence[Column]:
    """The clocks, in s if their units differ."""
    if len({(clock.unit, clock.kind) for clock in clocks}) == 1:
        return clocks
    found = []
    for clock in clocks:
        unit = unit_of("ns" if clock.kind == "date" else clock.unit)
        values = clock.values * (unit.factor if unit and unit.si == "s" else 1.0)
        found.append(replace(clock, name="time", unit="s", values=values, exact=None, kind="number"))
    return found


def _on_one_clock(
    groups: Sequence[tuple[Column, Sequence[Column]]],
) -> tuple[tuple[Column, ...], NDArray[np.int64]]:
    """The instants of all clocks as one column of time, and the columns of each group at those of its clock, (n,); and
    for each row that of the group that it came from first, (n,)."""
    exact = all(clock.exact is not None for clock, _ in groups)
    rows = [np.flatnonzero(np.isfinite(clock.values)) for clock, _ in groups]
    times = [(clock.exact if exact else clock.values)[at] for (clock, _), at in zip(groups, rows, strict=True)]  # type: ignore[index]
    rows = [at[np.argsort(time, kind="stable")] for at, time in zip(rows, times, strict=True)]
    times = [np.sort(time, kind="stable") for time in times]
    again = [np.arange(len(time)) - np.searchsorted(time, time) for time in times]  # of instants that repeat
    whole, repeated = np.concatenate(times), np.concatenate(again)
    order = np.lexsort((repeated, whole))
    new = np.ones(len(order), bool)
    new[1:] = (np.diff(whole[order]) != 0) | (np.diff(repeated[order]) != 0)
    place = np.empty(len(order), dtype=np.int64)
    place[order] = np.cumsum(new) - 1
    time = whole[order][new]
    clock = replace(groups[0][0], values=time.astype(np.float64), exact=time.astype(np.int64) if exact else None)
    columns, begin = [clock], 0
    for (_, own), at in zip(groups, rows, strict=True):
        for column in own:
            values = np.full(len(time), np.nan)
            values[place[begin : begin + len(at)]] = column.values[at]
            columns.append(replace(column, values=values, exact=None))
        begin += len(at)
    return tuple(columns), np.concatenate(rows)[order][new]


def _of_names(table: RawTable, wanted: Sequence[Wanted]) -> RawTable:
    """A row for each value, with the name of its channel in a column of text, as one column for each name."""
    value = next((column for column in table.columns if column.name.lower() in VALUES), None)
    needed = {each.name.lower() for each in wanted}
    if value is None or not needed:
        return table
    for heading, texts in table.texts.items():
        names = dict.fromkeys(texts)
        if len(names) > 200 or not any(re.split(r"[/.]", name.lower())[-1] in needed for name in names):
            continue
        every = np.array(texts)
        more = [Column(name, name, "", np.where(every == name, value.values, np.nan)) for name in names if name]
        kept = tuple(column for column in table.columns if column is not value)
        said = f"a row for each value, of the channel that column {heading} names"
        return replace(table, columns=(*kept, *more), texts={}, said=(*table.said, said))
    return table
