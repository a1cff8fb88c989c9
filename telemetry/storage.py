"""Files of recordings, by their suffix: `.arrow` (Arrow IPC stream, what the recorder writes), `.parquet` and `.csv`
(column names = channel names).

A raw `.log` needs the vehicle file to become a recording, see `service.offline.replay`.
"""

from __future__ import annotations

from pathlib import Path

from telemetry.csv_file import read_csv, write_csv
from telemetry.errors import RecordingError
from telemetry.recording import Recording

SUFFIXES = (".arrow", ".parquet", ".csv")


def load(path: Path | str) -> Recording:
    """Read a recording, by its suffix: .arrow, .parquet or .csv.

    A stream that was cut off (by a crash, a full disk) is read up to its last whole batch; `truncated` then states it.

    Raises:
        RecordingError: the file cannot be read, is of another format, or holds no rows.
    """
    path = Path(path)
    if path.suffix not in SUFFIXES:
        raise _unknown_suffix(path, path.suffix)
    try:
        if path.suffix == ".csv":
            return read_csv(path)
        from telemetry.arrow_file import read_arrow, read_parquet

        return read_arrow(path) if path.suffix == ".arrow" else read_parquet(path)
    except OSError as error:
        raise RecordingError(
            str(path), "", f"cannot be read: {error.strerror or error}", remedy="Check the path and its permissions."
        ) from error
    except UnicodeDecodeError as error:
        raise RecordingError(str(path), "", "is not text", remedy="Save it as CSV in UTF-8.") from error


def save(recording: Recording, path: Path | str) -> None:
    """Write to `path`, by its suffix: .arrow, .parquet or .csv (which keeps no metadata)."""
    path = Path(path)
    match path.suffix:
        case ".arrow":
            from telemetry.arrow_file import write_arrow

            write_arrow(recording, path)
        case ".parquet":
            from telemetry.arrow_file import write_parquet

            write_parquet(recording, path)
        case ".csv":
            write_csv(recording, path)
        case suffix:
            raise _unknown_suffix(path, suffix)


def _unknown_suffix(path: Path, suffix: str) -> RecordingError:
    what = f"recordings are not stored as {suffix or 'files without a suffix'}"
    if suffix == ".log":
        remedy = "A raw CAN log needs its vehicle: `upright replay FILE --vehicle V`, or `upright convert` it first."
    else:
        remedy = f"Use one of {', '.join(SUFFIXES)}."
    return RecordingError(str(path), "", what, remedy=remedy)
