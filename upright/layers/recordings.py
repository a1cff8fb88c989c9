"""From the layers: recordings."""

from __future__ import annotations

from service.offline.read import read
from telemetry.errors import RecordingError
from telemetry.recording import Recording as Recorded
from telemetry.recording import describe
from telemetry.tables.mapping import Source, said_of

__all__ = [
    "Recorded",
    "RecordingError",
    "Source",
    "describe",
    "read",
    "said_of",
]
