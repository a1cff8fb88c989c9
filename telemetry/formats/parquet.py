"""Parquet (telemetry.tables.arrow_columns)."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from telemetry.tables.arrow_columns import read_parquet
from telemetry.tables.raw import RawTable


def read(path: Path) -> Sequence[RawTable]:
    """One table. Raises RecordingError, OSError."""
    return (read_parquet(path.read_bytes(), str(path)),)
