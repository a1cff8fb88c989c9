"""From the layers: recordings."""

from __future__ import annotations

from upright.service.offline.inputs.read import read
from upright.telemetry.errors import RecordingError
from upright.telemetry.formats.frame import table_of_frame
from upright.telemetry.options import Stated, in_python, statements
from upright.telemetry.recording import Recording as Recorded
from upright.telemetry.tables.mapping import Source, said_of
from upright.telemetry.tables.read import longest, recordings

__all__ = [
    "Recorded",
    "RecordingError",
    "Source",
    "Stated",
    "in_python",
    "longest",
    "read",
    "recordings",
    "said_of",
    "statements",
    "table_of_frame",
]
