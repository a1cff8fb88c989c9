"""Recordings written as Arrow IPC streams and Parquet files; telemetry.tables reads them.

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

from upright.telemetry.channels import ChannelTable
from upright.telemetry.recording import Recording


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
        columns = [_column(timestamp_ns), *map(_column, rows.T)]
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


def write_arrow(recording: Recording, path: Path) -> None:
    """Write a whole recording as one stream. Replaces `path`."""
    table = _table(recording)
    with pa.OSFile(str(path), "wb") as file, pa.ipc.new_stream(file, table.schema) as writer:
        writer.write_table(table)


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


def _column(values: NDArray[Any]) -> Any:
    """`values` (n,) for Arrow, in the same memory. `pa.array` would import pandas first, where that is installed: for a
    second on a slow computer, in which the recorder takes nothing."""
    values = np.ascontiguousarray(values)
    return pa.Array.from_buffers(pa.from_numpy_dtype(values.dtype), len(values), [None, pa.py_buffer(values)])


def _table(recording: Recording) -> Any:
    columns = [recording.timestamp_ns, *(recording.values[name] for name in recording.channels.names)]
    return pa.table([*map(_column, columns)], schema=_schema(recording.channels, recording.metadata))
