"""Files of recordings, by their suffix: `.arrow` (Arrow IPC stream, what the recorder writes), `.parquet` and `.csv`
(column names = channel names) are written; files of others are read, too (telemetry.formats, telemetry.tables).

A raw `.log` needs the vehicle file to become a recording, see `service.offline.inputs.replay`.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from upright.telemetry.csv_file import write_csv
from upright.telemetry.errors import RecordingError
from upright.telemetry.formats.files import raw_tables, unknown_suffix
from upright.telemetry.recording import Recording
from upright.telemetry.tables.mapping import NOTHING, Said
from upright.telemetry.tables.read import longest, recordings
from upright.telemetry.tables.wanted import Wanted

SUFFIXES = (".arrow", ".parquet", ".csv")
"""What is written."""


def load(path: Path | str, wanted: Sequence[Wanted] = (), user: Said = NOTHING) -> Recording:
    """Read a recording. Of a file with several, as a logger writes that began anew, the longest, which then states so.

    The rest is as for `load_all`.
    """
    return longest(load_all(path, wanted, user))


def load_all(path: Path | str, wanted: Sequence[Wanted] = (), user: Said = NOTHING) -> tuple[Recording, ...]:
    """All recordings in a file. Which format it has, is found by its content, or else by its suffix.

    `wanted` are the channels that a model needs, and `user` is what the user says of the columns; what was assumed
    besides is in `Recording.assumed`. A stream that was cut off (by a crash, a full disk) is read up to its last whole
    batch; `truncated` then states it.

    Raises:
        RecordingError: the file cannot be read, is of another format, or holds no rows.
    """
    path = Path(path)
    try:
        return recordings(raw_tables(path), wanted, user)
    except OSError as error:
        raise RecordingError(
            str(path), "", f"cannot be read: {error.strerror or error}", remedy="Check the path and its permissions."
        ) from error


def save(recording: Recording, path: Path | str) -> None:
    """Write to `path`, by its suffix: .arrow, .parquet or .csv (which keeps no metadata)."""
    path = Path(path)
    match path.suffix:
        case ".arrow":
            from upright.telemetry.arrow_file import write_arrow

            write_arrow(recording, path)
        case ".parquet":
            from upright.telemetry.arrow_file import write_parquet

            write_parquet(recording, path)
        case ".csv":
            write_csv(recording, path)
        case _:
            raise unknown_suffix(path, SUFFIXES)
