"""Tables of text: CSV in all its dialects (telemetry.tables.text)."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from telemetry.tables.raw import RawTable
from telemetry.tables.text.text_file import read_text


def read(path: Path) -> Sequence[RawTable]:
    """One table. Raises RecordingError, OSError."""
    return (read_text(path.read_bytes(), str(path)),)
