"""Arrow IPC streams and files, and Feather (telemetry.tables.arrow_columns)."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from telemetry.tables.arrow_columns import read_arrow
from telemetry.tables.raw import RawTable


def read(path: Path) -> Sequence[RawTable]:
    """One table. Raises RecordingError, OSError."""
    return (read_arrow(path.read_bytes(), str(path)),)
