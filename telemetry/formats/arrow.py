"""Arrow IPC streams and files, Feather, and tables of pyarrow and pandas."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute
import pyarrow.ipc

from upright.telemetry.errors import RecordingError
from upright.telemetry.formats.text.fields import Decimal, numbers
from upright.telemetry.formats.text.text_file import unique
from upright.telemetry.tables.raw import Column, RawTable
from upright.telemetry.tables.units import name_and_unit

END_OF_STREAM = b"\xff\xff\xff\xff\x00\x00\x00\x00"
"""The last eight bytes of a stream that was closed."""
HIDDEN = ("pandas", "ARROW:schema")


def read(path: Path) -> Sequence[RawTable]:
    """One table: a stream, up to its last whole batch if it was cut off, or a file (Feather).

    Raises RecordingError, OSError.
    """
    return (_table(path.read_bytes(), str(path)),)


def _table(content: bytes, source: str) -> RawTable:
    if content.startswith((b"ARROW1", b"FEA1")):
        return raw(_file(content, source), source)
    batches = []
    late: dict[str, str] = {}
    lost = ""
    try:
        reader = pa.ipc.open_stream(content)
    except (pa.ArrowException, OSError) as error:
        raise RecordingError(
            source,
            "",
            "is not an Arrow stream, or was cut off before its first row",
            remedy="If a raw log (.log) lies beside it, `upright convert` rebuilds the recording from that.",
        ) from error
    try:
        while True:
            batch, own = reader.read_next_batch_with_custom_metadata()
            batches.append(batch)
            late.update(_text(own))
    except StopIteration:
        if not content.endswith(END_OF_STREAM):
            lost = "the recording was not closed: it ends with its last whole batch"
    except (pa.ArrowException, OSError):
        lost = "the recording is cut off in the middle of a batch: it ends with the batch before"
    return raw(pa.Table.from_batches(batches, schema=reader.schema), source, late, lost)


def of_frame(frame: Any, source: str) -> RawTable:
    """A DataFrame of pandas; an index of dates or durations is its first column. Raises RecordingError."""
    whole = frame.reset_index() if frame.index.dtype.kind in "mM" else frame
    return raw(pa.Table.from_pandas(whole, preserve_index=False), source)


def _file(content: bytes, source: str) -> Any:
    try:
        if content.startswith(b"FEA1"):
            from pyarrow import feather

            return feather.read_table(pa.BufferReader(content))
        return pa.ipc.open_file(pa.BufferReader(content)).read_all()
    except (pa.ArrowException, OSError, ValueError) as error:
        remedy = "A file that was cut off has no index: write it again, or as an Arrow stream."
        raise RecordingError(source, "", "is not a complete Arrow file", remedy=remedy) from error


def raw(table: Any, source: str, late: dict[str, str] | None = None, truncated: str = "") -> RawTable:
    """A table of pyarrow; `late` metadata came after its columns. Raises RecordingError."""
    try:
        return _columns(table, source, late or {}, truncated)
    except (pa.ArrowException, UnicodeError) as error:
        remedy = "Write the file again: names are text in UTF-8."
        raise RecordingError(source, "", f"is damaged: {error}", remedy=remedy) from error


def _columns(table: Any, source: str, late: dict[str, str], truncated: str) -> RawTable:
    said: list[str] = []
    own = {key: text for key, text in _text(table.schema.metadata).items() if key not in HIDDEN}
    columns, texts = [], {}
    table = _flat(table)
    for heading, field, values in zip(unique(table.column_names, said), table.schema, table.columns, strict=True):
        unit = _text(field.metadata).get("unit", "")
        name, written = (heading, "") if unit else name_and_unit(heading)
        try:
            column = _column(heading, name, unit or written, values, said)
        except (pa.ArrowException, ValueError, OverflowError, TypeError):
            column = None
            said.append(f"{heading}: of type {field.type}, left out")
        if column is not None:
            columns.append(column)
        elif pa.types.is_string(field.type) or pa.types.is_dictionary(field.type):
            texts[heading] = tuple("" if each is None else str(each) for each in values.to_pylist())
    lines = np.arange(1, table.num_rows + 1, dtype=np.int64)
    return RawTable(source, tuple(columns), lines, texts, {**own, **late}, tuple(said), truncated)


def _flat(table: Any) -> Any:
    """Fields of structs as columns of their own, named by a path."""
    for _ in range(8):
        if not any(pa.types.is_struct(field.type) for field in table.schema):
            break
        table = table.flatten()
    return table


def _column(heading: str, name: str, unit: str, values: Any, said: list[str]) -> Column | None:
    kind = values.type
    if pa.types.is_null(kind) or values.null_count == len(values) > 0:
        said.append(f"{heading}: without any value, left out")
        return None
    if pa.types.is_dictionary(kind):
        values, kind = values.cast(kind.value_type), kind.value_type
    if pa.types.is_timestamp(kind) or pa.types.is_date(kind):
        ns = values.cast(pa.timestamp("ns", getattr(kind, "tz", None))).cast(pa.int64())
        return _integers(heading, name, "ns", ns, "date")
    if pa.types.is_duration(kind):
        return _integers(heading, name, "ns", values.cast(pa.duration("ns")).cast(pa.int64()), "number")
    if pa.types.is_time(kind):
        ns = values.cast(pa.time64("ns")).cast(pa.int64())
        return _integers(heading, name, "ns", ns, "time of day")
    if pa.types.is_integer(kind):
        if kind == pa.uint64():
            return Column(heading, name, unit, values.to_numpy().astype(np.float64))
        return _integers(heading, name, unit, values.cast(pa.int64()), "number")
    if pa.types.is_floating(kind):
        return Column(heading, name, unit, values.to_numpy().astype(np.float64))
    if pa.types.is_decimal(kind):
        said.append(f"{heading}: decimals ({kind}), read as floating point")
        return Column(heading, name, unit, values.cast(pa.float64()).to_numpy().astype(np.float64))
    if pa.types.is_boolean(kind):
        said.append(f"{heading}: yes or no, read as 1 or 0")
        return Column(heading, name, unit, values.cast(pa.int8()).to_numpy().astype(np.float64), None, "yes or no")
    if pa.types.is_string(kind) or pa.types.is_large_string(kind):
        fields = ["" if each is None else each for each in values.to_pylist()]
        found = numbers(fields, Decimal())
        if found.kind != "text":
            said.append(f"{heading}: text, read as {'numbers' if found.kind == 'number' else found.kind}")
            return Column(heading, name, unit or found.unit, found.values, found.exact, found.kind)
        said.append(f"{heading}: text, left out")
        return None
    said.append(f"{heading}: of type {kind}, left out")
    return None


def _integers(heading: str, name: str, unit: str, values: Any, kind: str) -> Column:
    numbers = values.to_numpy()
    if values.null_count:
        return Column(heading, name, unit, numbers.astype(np.float64), None, kind)
    return Column(heading, name, unit, numbers.astype(np.float64), numbers.astype(np.int64), kind)


def _text(metadata: Any) -> dict[str, str]:
    return {key.decode(errors="replace"): value.decode(errors="replace") for key, value in (metadata or {}).items()}
