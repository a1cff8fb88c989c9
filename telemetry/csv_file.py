"""Recordings written as CSV: a header of channel names, `time` in s, one row per control cycle, SI units, no metadata.
telemetry.tables reads them, and those of others.

Numbers are written so that they read back bit for bit, and `time` to the nanosecond since the first row; the absolute
time of the start is not kept.
"""

from __future__ import annotations

import csv
from pathlib import Path

from upright.telemetry.recording import Recording


def write_csv(recording: Recording, path: Path) -> None:
    """Write `recording`; `time` starts at 0."""
    names = recording.channels.names
    columns = [recording.values[name].tolist() for name in names]
    start = int(recording.timestamp_ns[0])
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(("time", *names))
        for timestamp_ns, row in zip(recording.timestamp_ns.tolist(), zip(*columns, strict=True), strict=True):
            since = timestamp_ns - start
            writer.writerow((f"{since // 1_000_000_000}.{since % 1_000_000_000:09d}", *map(repr, row)))
