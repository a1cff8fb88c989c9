"""Recordings as CSV: a header of channel names, `time` in s, one row per control cycle, SI units, no metadata.

Numbers are written so that they read back bit for bit, and `time` to the nanosecond since the first row; the absolute
time of the start is not kept.
"""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np

from telemetry.errors import RecordingError
from telemetry.recording import Recording, describe, instants, refuse_repeated


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


def read_csv(path: Path) -> Recording:
    """Read a CSV file with a header; an empty field is an unknown value (NaN).

    Raises:
        RecordingError: no `time` column, a field that is not a number (with its line), or lines of differing length.
    """
    with path.open(newline="", encoding="utf-8-sig") as file:
        lines = csv.reader(file)
        header = [name.strip() for name in next(lines, [])]
        if "time" not in header:
            raise RecordingError(
                str(path), "time", "is missing from the header", remedy="Name the column of seconds `time`."
            )
        refuse_repeated(header, str(path))
        rows: list[list[float]] = []
        truncated = ""
        for fields in lines:
            if not fields:
                continue
            try:
                row = [float(text) if text.strip() else np.nan for text in fields]
                if len(row) != len(header):
                    raise ValueError(f"{len(row)} fields for {len(header)} columns")
            except ValueError as error:
                if next(lines, None) is None:
                    truncated = f"line {lines.line_num} is cut off and was left out ({error})"
                    break
                raise RecordingError(
                    str(path),
                    f"line {lines.line_num - 1}",
                    str(error),
                    remedy="Write one number per field, with a decimal point, and commas between fields.",
                ) from error
            rows.append(row)
    table = np.array(rows, dtype=np.float64).reshape(-1, len(header))
    time = table[:, header.index("time")]
    names = [name for name in header if name != "time"]
    return Recording(
        channels=describe(dict.fromkeys(names, "")),
        timestamp_ns=instants(time, 1e9, str(path)),
        values={name: table[:, header.index(name)].copy() for name in names},
        truncated=truncated,
        source=str(path),
    )
