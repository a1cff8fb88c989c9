"""Parquet."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet

from upright.telemetry.errors import RecordingError
from upright.telemetry.formats.arrow import raw
from upright.telemetry.tables.raw import RawTable


def read(path: Path) -> Sequence[RawTable]:
    """One table. Raises RecordingError, OSError."""
    content, source = path.read_bytes(), str(path)
    try:
        table = pa.parquet.read_table(pa.BufferReader(content))
    except (pa.ArrowException, OSError, ValueError) as error:
        raise RecordingError(
            source,
            "",
            "is not a complete Parquet file",
            remedy="A Parquet file that was cut off is lost: convert it again from the .arrow recording.",
        ) from error
    return (raw(table, source),)
