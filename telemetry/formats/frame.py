"""Tables in memory as raw tables: of pandas or polars, an array with named fields, or a mapping of names to arrays."""

from __future__ import annotations

import difflib
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from upright.telemetry.errors import RecordingError
from upright.telemetry.formats.text.fields import Decimal, numbers
from upright.telemetry.recording import FARTHEST
from upright.telemetry.tables.raw import Column, RawTable
from upright.telemetry.tables.units import unit_of

TIME = "time"
NUMBERS, DATES, DURATIONS, TEXTS = "biuf", "M", "m", "OUS"
"""Kinds of numpy's types."""


def table_of_frame(frame: Any, units: Mapping[str, str], metadata: Mapping[str, str], source: str) -> RawTable:
    """The columns of `frame` under their names: `time` in s or as dates, the others in SI units or in those of `units`.

    Columns of text are left out, and unknown values are NaN, as of a file. Raises RecordingError.
    """
    given = _columns(frame, source)
    if TIME not in given:
        near = difflib.get_close_matches(TIME, [name.lower() for name in given], n=1)
        what = f"is missing; there are {', '.join(given) or 'no columns'}"
        remedy = f"Is it {next(name for name in given if name.lower() == near[0])!r}? " if near else ""
        raise RecordingError(source, TIME, what, remedy=f"{remedy}Name the column of seconds `time`.")
    _check_units(units, list(given), source)
    said: list[str] = []
    arrays = {name: _array(name, values, source) for name, values in given.items()}
    count = len(arrays[TIME])
    for name, array in arrays.items():
        if len(array) != count:
            what = f"has {len(array)} values for {count} instants"
            raise RecordingError(source, name, what, remedy="Give every column the same length.")
    if not count:
        raise RecordingError(source, "", "holds no rows", remedy="Give a table with rows.")
    found = [column for name, array in arrays.items() if (column := _column(name, array, said)) is not None]
    columns = [_in_si(column, units.get(column.name, ""), said) for column in found]
    _check_time(columns, source)
    if len(columns) == 1:
        what = f"has no column of numbers beside time: {'; '.join(said) or 'there is none'}"
        raise RecordingError(source, "", what, remedy="Leave out columns that are not numbers, and add some that are.")
    lines = np.arange(1, count + 1, dtype=np.int64)
    own = {str(key): str(value) for key, value in metadata.items()}
    return RawTable(source, tuple(columns), lines, {}, own, tuple(said))


def _columns(frame: Any, source: str) -> dict[str, Any]:
    """The columns by name; an index of dates or durations, or one that is called `time`, is the time if no other is."""
    if hasattr(frame, "collect_schema") and not hasattr(frame, "__len__"):
        remedy = "Give frame.collect() instead of frame."
        raise RecordingError(source, "", f"is a {type(frame).__name__}, which has no values yet", remedy=remedy)
    fields = getattr(getattr(frame, "dtype", None), "names", None)
    columns: Any = getattr(frame, "columns", frame if isinstance(frame, Mapping) else ())
    names = list(columns if fields is None else fields)
    if not names and not isinstance(frame, Mapping) and not hasattr(frame, "columns"):
        remedy = "Give a table of pandas or polars, or a mapping of names to arrays."
        raise RecordingError(source, "", f"is no table, but of type {type(frame).__name__}", remedy=remedy)
    twice = [name for name, count in Counter(map(str, names)).items() if count > 1]
    if twice:
        raise RecordingError(source, twice[0], "is a column twice", remedy="Give every column a name of its own.")
    found = {str(name): frame[name] for name in names}
    index = getattr(frame, "index", None) if hasattr(frame, "columns") else None
    kind = getattr(getattr(index, "dtype", None), "kind", "")
    if TIME not in found and (kind in ("M", "m") or getattr(index, "name", None) == TIME):
        return {TIME: index, **found}
    return found


def _check_units(units: Mapping[str, str], names: Sequence[str], source: str) -> None:
    for name, unit in units.items():
        if name not in names:
            near = difflib.get_close_matches(name, names, n=1)
            remedy = f"Is it {near[0]!r}?" if near else f"Give units of {', '.join(names)}."
            raise RecordingError(source, name, "has a unit, but is no column", remedy=remedy)
        known = unit_of(unit)
        if name == TIME and (known is None or known.si != "s"):
            raise RecordingError(source, TIME, f"cannot be in {unit}", remedy="Give s, ms, us or ns.")


def _check_time(columns: Sequence[Column], source: str) -> None:
    """Raises RecordingError for a time that is no number, or that ns cannot count."""
    time = next((column for column in columns if column.name == TIME), None)
    if time is None:
        raise RecordingError(source, TIME, "is not of numbers or dates", remedy="Give seconds, or dates.")
    if not np.isfinite(time.values).any():
        raise RecordingError(source, TIME, "is not a number in any row", remedy="Give seconds, or dates.")
    unit = unit_of(time.unit)
    limit = 1e-9 * FARTHEST / (unit.factor if unit else 1.0)
    beyond = np.flatnonzero(np.isfinite(time.values) & ~(np.abs(time.values) < limit))
    if len(beyond):
        what = f"is no second of this century, the first in row {beyond[0] + 1}"
        raise RecordingError(source, TIME, what, remedy='State its unit: units={"time": "ms"} (or us, ns).')


def _array(name: str, values: Any, source: str) -> NDArray[Any]:
    """A column as an array (n,); unknown numbers are NaN."""
    kind = getattr(getattr(values, "dtype", None), "kind", "")
    array: NDArray[Any]
    try:
        if isinstance(values, np.ma.MaskedArray):
            array = np.ma.filled(values.astype(np.float64), np.nan)
        elif getattr(getattr(values, "dtype", None), "tz", None) is not None:
            array = np.asarray(values, dtype="datetime64[ns]")  # in UTC
        elif hasattr(getattr(values, "dtype", None), "na_value") and kind in NUMBERS:  # of pandas, with unknown values
            array = values.to_numpy(dtype=np.float64, na_value=np.nan)
        else:
            array = np.asarray(values)
    except (TypeError, ValueError, OverflowError) as error:
        raise RecordingError(source, name, f"is no column ({error})", remedy="Give an array of numbers.") from error
    if array.ndim != 1:
        what = f"has the shape {array.shape}, which is no column"
        raise RecordingError(source, name, what, remedy="Give each channel a column of its own.")
    return array


def _column(name: str, array: NDArray[Any], said: list[str]) -> Column | None:
    """None, if it is not of numbers, dates or durations."""
    kind = array.dtype.kind
    if kind in NUMBERS:
        if kind == "b":
            said.append(f"{name}: yes or no, read as 1 or 0")
        exact = array.astype(np.int64) if kind == "i" else None
        return Column(name, name, "", array.astype(np.float64), exact)
    if kind == DATES:
        return _dates(name, array, said)
    if kind == DURATIONS:
        return Column(name, name, "s", array / np.timedelta64(1, "s"))
    if kind in TEXTS:
        return _of_texts(name, array, said)
    said.append(f"{name}: of type {array.dtype}, left out")
    return None


def _dates(name: str, array: NDArray[Any], said: list[str]) -> Column:
    """Dates as ns since 1970; what ns cannot count is not known."""
    seconds = array.astype("datetime64[s]").astype(np.int64)
    far = ~np.isnat(array) & (np.abs(seconds) > FARTHEST // 1_000_000_000)
    if far.any():
        said.append(f"{name}: {np.count_nonzero(far)} dates outside of 1823 to 2116 are not known")
    ns = array.astype("datetime64[ns]").astype(np.int64)
    unknown = far | np.isnat(array)
    if unknown.any():
        return Column(name, name, "ns", np.where(unknown, np.nan, ns.astype(np.float64)), None, "date")
    return Column(name, name, "ns", ns.astype(np.float64), ns, "date")


def _of_texts(name: str, array: NDArray[Any], said: list[str]) -> Column | None:
    """Texts that are numbers or dates, or any objects that print as such."""
    found = numbers([_text(each) for each in array], Decimal())
    if found.kind == "text":
        said.append(f"{name}: text, left out")
        return None
    if any(isinstance(each, str | bytes) for each in array):
        said.append(f"{name}: text, read as {'numbers' if found.kind == 'number' else found.kind}")
    if found.odd:
        row, text = found.odd[0]
        said.append(f"{name}: {len(found.odd)} values are no numbers and not known, in row {row + 1}: {text[:40]!r}")
    return Column(name, name, found.unit, found.values, found.exact, found.kind)


def _text(value: Any) -> str:
    return value.decode(errors="replace") if isinstance(value, bytes) else str(value)


def _in_si(column: Column, unit: str, said: list[str]) -> Column:
    """A channel in SI, from the `unit` that the user states. A time keeps its unit, s if none is stated."""
    if column.kind != "number" or column.name == TIME:
        own = column.unit or unit or "s"
        return replace(column, unit=own) if column.name == TIME else column
    known = unit_of(unit)
    if known is None or known.factor == 1.0:
        return replace(column, unit=known.si if known else unit or column.unit)
    said.append(f"{column.name}: {unit}, converted to {known.si}")
    return replace(column, unit=known.si, values=column.values * known.factor, exact=None)
