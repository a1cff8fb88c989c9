"""Recordings as Arrow IPC streams and Parquet files.

Columns: `timestamp_ns` int64, then one float64 per channel with its unit and meaning as field metadata. What is known
of the run is schema metadata; what is known only at its end is metadata of the last batch of a stream. A stream is
appended batch by batch and can be read up to the last whole batch, whatever happens to its writer.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.ipc
import pyarrow.parquet
from numpy.typing import NDArray

from telemetry.channels import ChannelTable
from telemetry.errors import RecordingError
from telemetry.recording import Recording, describe, instants, refuse_repeated

END_OF_STREAM = b"\xff\xff\xff\xff\x00\x00\x00\x00"
"""The last eight bytes of a stream that was closed."""


class ArrowStreamWriter:
    """Appends batches of rows to a new `.arrow` file; each is on the disk when `append` returns.

    Raises OSError (FileExistsError if `path` exists: no recording is ever overwritten).
    """

    def __init__(self, path: Path, channels: ChannelTable, metadata: Mapping[str, str]) -> None:
        self._schema = _schema(channels, metadata)
        self._file = path.open("xb")
        self._writer = pa.ipc.new_stream(self._file, self._schema)
        self.append(np.empty(0, dtype=np.int64), np.empty((0, len(channels))))

    def append(
        self, timestamp_ns: NDArray[np.int64], rows: NDArray[np.float64], metadata: Mapping[str, str] | None = None
    ) -> None:
        """Rows (n, channels) at `timestamp_ns` (n,), with `metadata` of their own."""
        columns = [pa.array(timestamp_ns), *(pa.array(np.ascontiguousarray(column)) for column in rows.T)]
        batch = pa.record_batch(columns, schema=self._schema)
        self._writer.write_batch(batch, custom_metadata=dict(metadata) if metadata else None)
        self._file.flush()
        os.fsync(self._file.fileno())

    def close(self, metadata: Mapping[str, str] | None = None) -> None:
        """End the stream; `metadata`, which became known during the run, is read back with the rest."""
        with self._file:
            if metadata:
                self.append(np.empty(0, dtype=np.int64), np.empty((0, len(self._schema) - 1)), metadata)
            self._writer.close()
            self._file.flush()
            os.fsync(self._file.fileno())


def read_arrow(path: Path) -> Recording:
    """Read a stream, up to its last whole batch if it was cut off. Raises RecordingError, OSError."""
    with path.open("rb") as file:
        content = file.read()
    batches = []
    late: dict[str, str] = {}
    lost = ""
    try:
        reader = pa.ipc.open_stream(content)
    except (pa.ArrowException, OSError) as error:
        raise RecordingError(
            str(path),
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
    return _recording(pa.Table.from_batches(batches, schema=reader.schema), path, late, lost)


def write_arrow(recording: Recording, path: Path) -> None:
    """Write a whole recording as one stream. Replaces `path`."""
    table = _table(recording)
    with pa.OSFile(str(path), "wb") as file, pa.ipc.new_stream(file, table.schema) as writer:
        writer.write_table(table)


def read_parquet(path: Path) -> Recording:
    """Read a Parquet file. Raises RecordingError, OSError."""
    try:
        table = pa.parquet.read_table(path)
    except pa.ArrowInvalid as error:
        raise RecordingError(
            str(path),
            "",
            "is not a complete Parquet file",
            remedy="A Parquet file that was cut off is lost: convert it again from the .arrow recording.",
        ) from error
    return _recording(table, path, {}, "")


def write_parquet(recording: Recording, path: Path) -> None:
    """Write a whole recording. Replaces `path`."""
    pa.parquet.write_table(_table(recording), path)


def _schema(channels: ChannelTable, metadata: Mapping[str, str]) -> Any:
    fields = [pa.field("timestamp_ns", pa.int64(), nullable=False, metadata={"unit": "ns", "meaning": "Unix time"})]
    fields += [
        pa.field(channel.name, pa.float64(), metadata={"unit": channel.unit, "meaning": channel.meaning})
        for channel in channels
    ]
    return pa.schema(fields, metadata=dict(metadata))


def _table(recording: Recording) -> Any:
    columns = [recording.timestamp_ns, *(recording.values[name] for name in recording.channels.names)]
    return pa.table([pa.array(column) for column in columns], schema=_schema(recording.channels, recording.metadata))


def _recording(table: Any, path: Path, late: dict[str, str], truncated: str) -> Recording:
    """Reads `timestamp_ns`, or `time` in s if the table comes from elsewhere; every other column is a channel."""
    names = table.column_names
    if not {"timestamp_ns", "time"} & set(names):
        raise RecordingError(
            str(path), "time", "is missing", remedy="Name the column of seconds `time`, or of ns `timestamp_ns`."
        )
    refuse_repeated(names, str(path))
    for field in table.schema:
        if not (pa.types.is_floating(field.type) or pa.types.is_integer(field.type)):
            remedy = "A channel is a column of numbers: leave it out."
            raise RecordingError(str(path), field.name, f"is of type {field.type}", remedy=remedy)
    if "timestamp_ns" in names:
        timestamp_ns = instants(table.column("timestamp_ns").to_numpy(), 1.0, str(path))
    else:
        timestamp_ns = instants(table.column("time").to_numpy(), 1e9, str(path))
    values, units = {}, {}
    for field in table.schema:
        if field.name in ("timestamp_ns", "time"):
            continue
        values[field.name] = table.column(field.name).to_numpy().astype(np.float64)
        units[field.name] = _text(field.metadata).get("unit", "")
    own = {key: text for key, text in _text(table.schema.metadata).items() if key not in ("pandas", "ARROW:schema")}
    return Recording(
        channels=describe(units),
        timestamp_ns=timestamp_ns,
        values=values,
        metadata={**own, **late},
        truncated=truncated,
        source=str(path),
    )


def _text(metadata: Any) -> dict[str, str]:
    return {key.decode(): value.decode() for key, value in (metadata or {}).items()}
