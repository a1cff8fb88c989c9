"""Tables in which channels have a column of time of their own (`Time, Ch1, Time, Ch2`), or a row for each value
(`time, name, value`)."""

from __future__ import annotations

import itertools
import re
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from telemetry.tables.raw import Column, RawTable
from telemetry.tables.times import is_time_name
from telemetry.tables.wanted import Wanted

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
    parts = [np.flatnonzero(np.isfinite(clock.values)) for clock in clocks]
    source = np.concatenate(parts)
    group = np.repeat(np.arange(len(parts)), [len(each) for each in parts])
    time = np.concatenate([clock.values[rows] for clock, rows in zip(clocks, parts, strict=True)])
    order = np.argsort(time, kind="stable")
    source, group = source[order], group[order]
    exact = None
    if all(clock.exact is not None for clock in clocks):
        exact = np.array([clocks[one].exact[row] for one, row in zip(group, source, strict=True)])  # type: ignore[index]
    columns: list[Column] = [replace(clocks[0], values=time[order], exact=exact)]
    for number, (begin, end) in enumerate(zip(places, ends, strict=True)):
        for column in table.columns[begin + 1 : end]:
            values = np.where(group == number, column.values[source], np.nan)
            columns.append(replace(column, values=values, exact=None))
    said = f"time: {len(clocks)} columns of time, one for each group of channels"
    return replace(table, columns=tuple(columns), lines=table.lines[source], texts={}, said=(*table.said, said))


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
