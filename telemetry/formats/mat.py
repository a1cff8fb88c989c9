"""MAT files of MATLAB and Simulink: vectors, structs, timeseries, timetables, and Datasets of signals.

scipy reads versions 4 to 7; version 7.3 and objects such as timeseries take mat-io, the extra `upright[mat]`. Both give
structs as arrays of records and cells as arrays of objects.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from upright.telemetry.formats import mat_elements
from upright.telemetry.formats.arrow import of_frame
from upright.telemetry.formats.columns import seconds, table_of
from upright.telemetry.tables.raw import Column, RawTable
from upright.telemetry.tables.times import is_time_name
from upright.telemetry.tables.units import name_and_unit

MOST = 64
"""Columns up to which a matrix is channels."""
CARRIERS = ("values", "elements", "storage", "element")
"""Fields that carry signals under the name of what they are in."""
UNITS = {"seconds": "s", "milliseconds": "ms", "microseconds": "us", "minutes": "min", "hours": "h", "days": "d"}
"""Of timeseries."""
HDF5 = b"\x89HDF\r\n\x1a\n"
"""What a file of version 7.3 has behind its header of 512 bytes."""
OBJECT = "__function_workspace__"
"""What scipy has of objects that it cannot read."""


def read(path: Path) -> Sequence[RawTable]:
    """A table for all vectors of the same length, unless they lack a time that others have, and one for each timeseries
    or struct with a time. Raises OSError, and what its packages raise."""
    variables = _variables(path)
    source, found = str(path), list[RawTable]()
    units, metadata = _texts(variables.get("unit")), _texts(variables.get("metadata"))
    for name, value in variables.items():
        found += _series(source, name, value)
    own = _vectors(source, "", dict(_flat("", variables)), units, metadata)
    if own is None or (found and not is_time_name(own.columns[0].name)):
        said = (f"without a time, left out: {', '.join(each.heading for each in own.columns)}",) if own else ()
        return [replace(each, said=(*each.said, *said)) for each in found]
    return [own, *found]


def _variables(path: Path) -> dict[str, Any]:
    import scipy.io.matlab

    with path.open("rb") as file:
        new = file.read(520)[512:] == HDF5
    if not new and scipy.io.matlab.matfile_version(path)[0] == 1:
        mat_elements.check(path)
    content = {} if new else scipy.io.loadmat(path)
    if OBJECT in content:
        mat_elements.check_workspace(content[OBJECT].tobytes())
    if new or OBJECT in content:
        from matio import load_from_mat

        content = load_from_mat(str(path))
    return {name: value for name, value in content.items() if not name.startswith("__") and name != "None"}


def _series(source: str, name: str, value: Any) -> Iterator[RawTable]:
    """The tables of a timeseries or timetable, of a struct with a time, and of all that are inside of a struct, object
    or cell."""
    if hasattr(value, "reset_index"):  # a table or timetable, which mat-io gives as a DataFrame
        yield of_frame(value, source)
    for fields in _records(value):
        own = _text(_field(fields, "name")) or name
        time, data, signals = (_field(fields, key) for key in ("time", "data", "signals"))
        if data is not None and (time is not None or _field(fields, "timeinfo") is not None):
            yield from _timeseries(source, own, fields)
        elif time is not None and signals is not None:
            yield from _signals(source, name, time, signals)
        elif _has_time(fields):
            table = _vectors(source, f"{name}/", dict(_flat("", fields)), {}, {})
            yield from [table] if table is not None else []
        else:
            for key, each in fields.items():
                yield from _series(source, own if _bare(key) in CARRIERS else f"{own}/{key}", each)
    if isinstance(value, np.ndarray) and value.dtype == object:
        for place, each in enumerate(value.ravel(order="F")):
            yield from _series(source, name if value.size == 1 else f"{name}[{place}]", each)


def _flat(path: str, fields: Mapping[str, Any]) -> Iterator[tuple[str, Any]]:
    """The values of `fields` by their paths, and those inside of structs that have no time of their own."""
    for name, value in fields.items():
        inner = list(_records(value))
        if len(inner) == 1 and not _has_time(inner[0]):
            yield from _flat(f"{path}{name}/", inner[0])
        elif not inner:
            yield f"{path}{name}", value


def _has_time(fields: Mapping[str, Any]) -> bool:
    return any(is_time_name(name_and_unit(key)[0]) for key in fields)


def _timeseries(source: str, name: str, fields: Mapping[str, Any]) -> Iterator[RawTable]:
    """A timeseries; evenly spaced ones have a start and an increment in place of their times."""
    data = _numbers(_field(fields, "data"))
    time = _numbers(_field(fields, "time"))
    about = next(_records(_field(fields, "timeinfo")), {})
    start, step = (_numbers(_field(about, key)) for key in ("start", "increment"))
    if data is None or data.size == 0:
        return
    if (time is None or time.size == 0) and start is not None and step is not None and step.size == 1:
        length = _number(_field(about, "length"))
        count = int(length) if length in data.shape else max(data.shape)
        time = float(start.flat[0] if start.size else 0.0) + float(step.flat[0]) * np.arange(count)
    if time is None or time.size == 0:
        return
    of_time, of_data = _units(about), _units(next(_records(_field(fields, "datainfo")), {}))
    columns = _columns(name, data, time.size, of_data)
    if columns:
        yield table_of(source, seconds(time.ravel(), of_time or "s"), columns)


def _signals(source: str, name: str, time: Any, signals: Any) -> Iterator[RawTable]:
    """Simulink's structure with time: its signals by their labels."""
    stamps = _numbers(time)
    if stamps is None or stamps.size == 0:
        return
    columns: list[Column] = []
    for place, fields in enumerate(_records(signals)):
        values = _numbers(_field(fields, "values"))
        label = _text(_field(fields, "label")) or f"{name}/signals[{place}]"
        if values is not None:
            columns += _columns(label, values, stamps.size, "")
    if columns:
        yield table_of(source, seconds(stamps.ravel()), columns)


def _vectors(
    source: str, prefix: str, fields: Mapping[str, Any], units: Mapping[str, str], metadata: Mapping[str, str]
) -> RawTable | None:
    """The vectors and matrices of numbers with as many rows as the column of time has, or as most have."""
    numbers = {name: array for name, value in fields.items() if (array := _numbers(value)) is not None}
    sizes = {name: max(array.shape) for name, array in numbers.items() if array.size > 1}
    times = [name for name in sizes if is_time_name(name_and_unit(name)[0])]
    if not sizes:
        return None
    count = sizes[times[0]] if times else Counter(sizes.values()).most_common(1)[0][0]
    columns: list[Column] = []
    odd: list[str] = []
    for name in sizes:
        array = numbers[name]
        heading = "column" if len(sizes) == 1 and array.ndim == 2 and min(array.shape) > 1 else f"{prefix}{name}"
        found = _columns(heading, array, count, units.get(name, ""))
        columns += found
        if not found:
            odd.append(f"{prefix}{name}")
    columns.sort(key=lambda column: not is_time_name(column.name))
    said = [f"of another length or of more than {MOST} columns, left out: {', '.join(odd)}"] if odd else []
    lines = np.arange(1, count + 1, dtype=np.int64)
    return RawTable(source, tuple(columns), lines, {}, dict(metadata), tuple(said)) if columns else None


def _columns(heading: str, values: NDArray[Any], count: int, unit: str) -> list[Column]:
    """A vector as a column, a matrix as one for each row or column; [] if none of its dimensions is `count`."""
    axis = next((place for place, size in enumerate(values.shape) if size == count), None)
    if axis is None:
        return []
    flat = np.moveaxis(values, axis, 0).reshape(count, -1)
    if flat.shape[1] > MOST:
        return []
    written, stated = name_and_unit(heading)
    name = heading if unit else written
    unit = unit or stated
    if flat.shape[1] == 1:
        return [_column(heading, name, unit, flat[:, 0])]
    if heading == "column":  # a lone matrix is a table without headings
        return [_column(f"column{place + 1}", f"column{place + 1}", "", each) for place, each in enumerate(flat.T)]
    return [_column(f"{heading}[{place}]", f"{name}[{place}]", unit, each) for place, each in enumerate(flat.T)]


def _column(heading: str, name: str, unit: str, values: NDArray[Any]) -> Column:
    exact = values.astype(np.int64) if values.dtype.kind in "iu" else None
    return Column(heading, name, unit, values.astype(np.float64), exact)


def _records(value: Any) -> Iterator[Mapping[str, Any]]:
    """The fields of a struct or object, for each of an array of them."""
    if isinstance(value, np.ndarray) and value.dtype.names:
        for each in value.ravel(order="F"):
            yield {key: each[key] for key in value.dtype.names}
    elif isinstance(getattr(value, "properties", None), Mapping):
        yield value.properties
    elif isinstance(value, np.ndarray) and hasattr(value, "classname"):
        for each in value.ravel(order="F"):
            yield from _records(each)


def _field(fields: Mapping[str, Any], name: str) -> Any:
    """A field whose name is `name` in any case, or with the underscore that fields of objects end with."""
    return next((value for key, value in fields.items() if _bare(key) == name), None)


def _bare(name: str) -> str:
    return name.rstrip("_").lower()


def _numbers(value: Any) -> NDArray[Any] | None:
    """A real array of numbers, None if it is anything else."""
    if isinstance(value, np.ndarray) and value.dtype.kind in "biuf":
        return np.asarray(value)
    return np.atleast_1d(value) if isinstance(value, bool | int | float) else None


def _number(value: Any) -> float:
    """A number, 0 if it is none."""
    found = _numbers(value)
    return float(found.flat[0]) if found is not None and found.size == 1 else 0.0


def _text(value: Any) -> str:
    """A text, "" if it is none."""
    while isinstance(value, np.ndarray) and value.size == 1:
        value = value.ravel()[0]
    return str(value) if isinstance(value, str) else ""


def _texts(value: Any) -> dict[str, str]:
    """A struct of texts alone; empty if it is anything else."""
    fields = next(_records(value), {})
    found = {key: _text(each) for key, each in fields.items()}
    return found if all(found[key] or _is_empty(each) for key, each in fields.items()) else {}


def _is_empty(value: Any) -> bool:
    return isinstance(value, np.ndarray) and value.size == 0


def _units(about: Mapping[str, Any]) -> str:
    """The unit in the metadata of a timeseries: a text, or an object with a name."""
    stated = _field(about, "units")
    text = _text(stated) or next((_text(_field(each, "name")) for each in _records(stated)), "")
    return UNITS.get(text, text)
