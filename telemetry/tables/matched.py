"""Which column is which channel, in the unit that is needed."""

from __future__ import annotations

import difflib
import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from upright.telemetry.errors import RecordingError
from upright.telemetry.options import assumed, mapped
from upright.telemetry.tables.mapping import Assumption, Said, Source, factor_of
from upright.telemetry.tables.raw import Column, RawTable
from upright.telemetry.tables.units import unit_of
from upright.telemetry.tables.wanted import Wanted

TURN = 2.0 * np.pi


@dataclass(frozen=True, slots=True)
class Matched:
    """A channel `name` from the column `heading`, in `unit` ("" if the file states none)."""

    name: str
    unit: str
    heading: str
    values: NDArray[np.float64]


def matched(
    table: RawTable, wanted: Sequence[Wanted], user: Said, times: Sequence[str]
) -> tuple[list[Matched], list[str]]:
    """All columns but those of `times` as channels: the `wanted` ones under their names and in their units, the others
    under their own, in SI units. Raises RecordingError for a column that is not clear."""
    said: list[str] = []
    rest = [column for column in table.columns if column.heading not in times]
    needed = {each.name: each for each in wanted}
    for name in {*user.columns, *user.assumed} - set(needed) - {"time"}:
        needed[name] = Wanted(name)
    sources = {name: column for name, each in needed.items() if (column := _source(table, rest, each, user))}
    sources = _swapped(sources, user, table, said)
    used = {column.heading for column in sources.values()}
    found = [_channel(needed[name], column, user, table, said) for name, column in sources.items()]
    names = {each.name for each in found}
    for column in rest:
        if column.heading in used:
            continue
        other = _other(column, column.name if column.name not in names else column.heading)
        if other.name in names:
            continue
        names.add(other.name)
        found.append(other)
    order = {column.heading: place for place, column in enumerate(table.columns)}
    return sorted(found, key=lambda each: order[each.heading]), said


def _source(table: RawTable, rest: Sequence[Column], wanted: Wanted, user: Said) -> Column | None:
    """The column of a channel: as the user says, or by its name, to the letter, in other letters, or as the last part
    of a path. None if there is none. Raises RecordingError if several fit."""
    asked = user.columns.get(wanted.name)
    name = asked.column if asked else wanted.name
    plain = re.sub(r"[\W_]+", "", name).lower()
    numbered = [column for column in rest if re.fullmatch(rf"{re.escape(name)} \(\d+\)", column.heading)]
    if not asked and any(column.heading == name for column in rest) and numbered:
        remedy = f"Give every column a name of its own, or say which: {mapped({name: numbered[0].heading})}."
        raise RecordingError(table.source, name, "occurs twice", remedy=remedy)
    ways = (
        lambda column: column.heading == name,
        lambda column: column.name == name,
        lambda column: column.name.lower() == name.lower() or column.heading.lower() == name.lower(),
        lambda column: bool(plain) and plain in (_plain(column.name), _plain(column.heading)),
        lambda column: _with_unit(column.name, name, wanted.unit),
        lambda column: _plain(re.split(r"[/.]", column.name)[-1]) == plain != "",
    )
    for fits in ways:
        found = [column for column in rest if fits(column)]
        if len(found) > 1:
            there = ", ".join(column.heading for column in found)
            remedy = f"Say which: {mapped({wanted.name: found[0].heading})}."
            raise RecordingError(table.source, wanted.name, f"may be any of {there}", remedy=remedy)
        if found:
            return found[0]
    if asked:
        headings = [column.heading for column in rest]
        near = difflib.get_close_matches(name, headings, n=1)
        what = f"there is no column {name!r}; there are {', '.join(headings)}"
        remedy = f"Is it {near[0]!r}?" if near else f"Name one of these: {mapped({wanted.name: 'COLUMN'})}."
        raise RecordingError(table.source, wanted.name, what, remedy=remedy)
    return None


def _with_unit(column: str, name: str, unit: str) -> bool:
    """Whether a column is called by the name and the unit of a channel: voltage_V."""
    bare, _, tail = column.rpartition("_")
    found, own = unit_of(tail), unit_of(unit)
    return found is not None and found == own and _plain(bare) == _plain(name) != ""


def may_be(column: Column, name: str) -> bool:
    """Whether a column may be the channel `name`, in one of the ways of names."""
    plain = _plain(name)
    return name in (column.heading, column.name) or (
        plain != "" and plain in map(_plain, (column.name, column.heading, re.split(r"[/.]", column.name)[-1]))
    )


def _plain(name: str) -> str:
    return re.sub(r"[\W_]+", "", name).lower()


def _swapped(sources: dict[str, Column], user: Said, table: RawTable, said: list[str]) -> dict[str, Column]:
    found = dict(sources)
    done: set[str] = set()
    for name, each in user.assumed.items():
        other = each.swapped
        if not other or name in done:
            continue
        if name not in sources or other not in sources:
            lacking = name if name not in sources else other
            remedy = f"There are {', '.join(sources)}."
            raise RecordingError(table.source, lacking, "cannot be swapped: it is no channel here", remedy=remedy)
        found[name], found[other] = sources[other], sources[name]
        done |= {name, other}
        said.append(f"{name} and {other}: swapped, as stated")
    return found


def _channel(wanted: Wanted, column: Column, user: Said, table: RawTable, said: list[str]) -> Matched:
    """The column as the channel, in its unit."""
    asked = user.columns.get(wanted.name, Source(column.heading))
    assumed = user.assumed.get(wanted.name, Assumption())
    if column.heading != wanted.name:
        said.append(f"{wanted.name}: column {column.heading!r}")
    stated = assumed.unit or asked.unit
    if stated:
        given = factor_of(stated)
        factor, si = (given.factor, given.si) if given else (1.0, "")
        factor /= _own_factor(wanted.unit) if si else 1.0
        if factor != 1.0:
            said.append(f"{wanted.name}: in {stated}, as stated: times {factor:.6g}")
        unit = wanted.unit
    else:
        factor, unit = _to(wanted, column, table, said)
    values = column.values
    if assumed.wrapped is not None:
        period = assumed.wrapped or TURN / abs(factor)
        values = unwrapped(values, period)
        said.append(f"{wanted.name}: unwrapped by {period:.6g}, as stated")
    return Matched(wanted.name, unit, column.heading, values * factor if factor != 1.0 else values)


def _own_factor(unit: str) -> float:
    """SI units in the unit that a model is written in."""
    found = unit_of(unit)
    return found.factor if found else 1.0


def _to(wanted: Wanted, column: Column, table: RawTable, said: list[str]) -> tuple[float, str]:
    """The factor from the unit that the file states to the wanted one."""
    found, own = unit_of(column.unit), unit_of(wanted.unit)
    if not column.unit:
        return 1.0, ""
    if found is None:
        if wanted.unit and column.unit.strip().lower() != wanted.unit.strip().lower():
            said.append(f"{wanted.name}: {column.unit} is not converted: read as {wanted.unit}")
        return 1.0, column.unit
    if own is None:
        if found.factor != 1.0:
            said.append(f"{wanted.name}: {column.unit}, converted to {found.si}")
        return found.factor, found.si
    if found.si != own.si:
        if column.unit == "g" and own.si == "kg":
            said.append(f"{wanted.name}: g, converted to kg")
            return 1e-3 / own.factor, wanted.unit
        what = f"is in {column.unit} in the file, and in {wanted.unit} in the model"
        unit = assumed({wanted.name: wanted.unit.replace("N m", "Nm")})
        remedy = f"Name its column: {mapped({wanted.name: 'COLUMN'})}, or state its unit: {unit}."
        raise RecordingError(table.source, wanted.name, what, remedy=remedy)
    factor = found.factor / own.factor
    if factor != 1.0:
        said.append(f"{wanted.name}: {column.unit}, converted to {wanted.unit}")
    return factor, wanted.unit


def _other(column: Column, name: str) -> Matched:
    """A column that no model needs."""
    unit = unit_of(column.unit)
    if unit is None or column.kind in ("date", "time of day"):
        return Matched(column.heading if column.unit else name, column.unit, column.heading, column.values)
    return Matched(name, unit.si, column.heading, column.values * unit.factor if unit.factor != 1.0 else column.values)


def unwrapped(values: NDArray[np.float64], period: float) -> NDArray[np.float64]:
    """`values` (n,) without jumps of a `period`; what is not known stays so."""
    found = values.copy()
    known = np.isfinite(values)
    found[known] = np.unwrap(values[known], period=period)
    return found
