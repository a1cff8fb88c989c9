"""From the layers: recordings."""

from __future__ import annotations

from upright.service.offline.inputs.read import read
from upright.telemetry.errors import RecordingError
from upright.telemetry.recording import Recording as Recorded
from upright.telemetry.recording import describe
from upright.telemetry.tables.mapping import Source, said_of

__all__ = [
    "Recorded",
    "RecordingError",
    "Source",
    "describe",
    "read",
    "said_of",
]
