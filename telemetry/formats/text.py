"""Tables of text: CSV in all its dialects (telemetry.tables.csv_text)."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from telemetry.tables.csv_text import read_text
from telemetry.tables.raw import RawTable


def read(path: Path) -> Sequence[RawTable]:
    """One table. Raises RecordingError, OSError."""
    return (read_text(path.read_bytes(), str(path)),)
