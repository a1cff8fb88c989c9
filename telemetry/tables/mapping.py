"""What the user says of a table: which column a channel is (`--map`, `[columns]`), and in what it is written
(`--assume`)."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from math import isfinite

from upright.telemetry.errors import UprightError
from upright.telemetry.options import assumed, mapped, option
from upright.telemetry.tables.units import Unit, is_unit, unit_of

ROW = "row"
"""A column that every table has: the number of the row, 0 for the first."""
WRAPPED, SWAPPED = "wrapped", "swapped"


class MappingError(UprightError):
    """A column or an assumption that cannot be understood. `text` is what was given."""

    def __init__(self, text: str, message: str, *, remedy: str) -> None:
        super().__init__(f"{text}: {message}.", remedy=remedy)
        self.text = text


@dataclass(frozen=True, slots=True)
class Source:
    """The `column` of a channel, and its `unit` if the user states it: a unit's name, or a factor."""

    column: str
    unit: str = ""


@dataclass(frozen=True, slots=True)
class Assumption:
    """How a channel is written: in `unit` (a unit's name or a factor, with a sign if it is turned), `wrapped` with a
    period in that unit (0 for a whole turn), and `swapped` with the column of another channel."""

    unit: str = ""
    wrapped: float | None = None
    swapped: str = ""

    @property
    def texts(self) -> list[str]:
        """As what the option `--assume` states of the channel."""
        said = [self.unit] if self.unit else []
        if self.wrapped is not None:
            said.append(WRAPPED if not self.wrapped else f"{WRAPPED}:{self.wrapped:g}")
        if self.swapped:
            said.append(f"{SWAPPED}:{self.swapped}")
        return said


@dataclass(frozen=True, slots=True)
class Said:
    """All that the user says of a table."""

    columns: Mapping[str, Source] = field(default_factory=dict)
    assumed: Mapping[str, Assumption] = field(default_factory=dict)

    @property
    def settled(self) -> frozenset[str]:
        """The channels whose unit the user states."""
        return frozenset(self.assumed) | {name for name, each in self.columns.items() if each.unit}

    def with_assumed(self, channel: str, more: Assumption) -> Said:
        """With one more assumption; what it leaves open stays as it is."""
        before = self.assumed.get(channel, Assumption())
        merged = Assumption(
            more.unit or before.unit,
            before.wrapped if more.wrapped is None else more.wrapped,
            more.swapped or before.swapped,
        )
        return replace(self, assumed={**self.assumed, channel: merged})


NOTHING = Said()


def columns_of(entries: Mapping[str, str]) -> dict[str, Source]:
    """The table `[columns]` of a model or vehicle file. Raises MappingError."""
    return dict(_column(f"{name} = {text!r}", name, text) for name, text in entries.items())


def said_of(maps: Iterable[str], assumes: Iterable[str], columns: Mapping[str, Source] | None = None) -> Said:
    """The options `--map` and `--assume`, after the `columns` of a file. Raises MappingError."""
    found = dict(columns or {})
    for text in maps:
        name, _, column = text.partition("=")
        given = option(f"--map {text}", mapped({name: column}))
        if not (name.strip() and column.strip()):
            example = mapped({"angle": "pos:deg"})
            raise MappingError(given, "names no channel or no column", remedy=f"Write {example}, for example.")
        found.update((_column(given, name, column),))
    said = Said(found)
    for text in assumes:
        name, _, how = text.partition("=")
        given = option(f"--assume {text}", assumed({name: how}))
        if not (name.strip() and how.strip()):
            example = assumed({"angle": "deg"})
            raise MappingError(given, "names no channel or no unit", remedy=f"Write {example}, for example.")
        said = said.with_assumed(name.strip(), _assumption(given, how.strip()))
    return said


def factor_of(text: str) -> Unit | None:
    """A unit's name, or a factor (`-1`, `0.05`, `12/255`), with a sign before either; None if it is neither."""
    text = text.strip()
    sign = -1.0 if text.startswith("-") and text != "-" else 1.0
    bare = text[1:].strip() if sign < 0.0 else text.removeprefix("+")
    if bare in ("sign", "turned"):
        return Unit("", sign)
    if unit := unit_of(bare):
        return Unit(unit.si, sign * unit.factor)
    found = re.fullmatch(r"([\d.]+(?:[eE][+-]?\d+)?)(?:\s*/\s*([\d.]+(?:[eE][+-]?\d+)?))?", bare)
    try:
        factor = float(found[1]) / float(found[2] or 1.0) if found else 0.0
    except (ValueError, ZeroDivisionError, OverflowError):
        return None
    return Unit("", sign * factor) if factor and isfinite(factor) else None


def _column(said: str, name: str, text: str) -> tuple[str, Source]:
    column, _, unit = text.rpartition(":")
    if column and factor_of(unit):
        return name.strip(), Source(column.strip(), unit.strip())
    if column and (is_unit(unit) or re.fullmatch(r"\w{1,4}", unit)) and "/" not in text:
        what = f"{unit!r} is no unit that is known"
        raise MappingError(said, what, remedy="Give deg, rpm, ms, mm, ... or a factor to SI units, such as 0.01.")
    return name.strip(), Source(text.strip())


def _assumption(said: str, how: str) -> Assumption:
    kind, _, more = how.partition(":")
    if kind == SWAPPED and more:
        return Assumption(swapped=more.strip())
    if kind == WRAPPED:
        try:
            period = float(more) if more else 0.0
        except ValueError:
            period = -1.0
        if not (isfinite(period) and period >= 0.0):
            raise MappingError(said, f"{more!r} is no period", remedy="Write wrapped, or wrapped:4096 for counts.")
        return Assumption(wrapped=period)
    if factor_of(how) is None:
        remedy = "Give a unit (deg, rpm, ms, mm), a factor to SI units (-1, 0.05, 12/255), wrapped, or swapped:CHANNEL."
        raise MappingError(said, f"{how!r} is no unit that is known", remedy=remedy)
    return Assumption(unit=how)
