"""The frames of ASC, TRC, BLF, CSV and MF4 files as messages of python-can, which reads all of them but the MF4.

A line that is no frame is counted in `skipped`, and the next one is read.
"""

from __future__ import annotations

import io
import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from gc import collect
from itertools import chain
from pathlib import Path
from typing import Any

import can
import numpy as np

from upright.telemetry.candump import Skipped, lines_of, open_text
from upright.telemetry.errors import RecordingError
from upright.telemetry.formats.files import missing, quiet
from upright.telemetry.formats.mf4 import opened

HEAD = 4096
"""Characters at the beginning of a file in which its header is."""

CHUNK = 100_000
"""Frames of an MF4 that are taken at once."""


class _Asc(can.ASCReader):
    """An ASC file in which a line may be wrong."""

    def __init__(self, file: Any, skipped: Skipped) -> None:
        super().__init__(file)
        self._skipped = skipped

    def _process_classic_can_frame(self, line: str, msg_kwargs: Any) -> Any:
        return self._lenient(super()._process_classic_can_frame, line, msg_kwargs)

    def _process_fd_can_frame(self, line: str, msg_kwargs: Any) -> Any:
        return self._lenient(super()._process_fd_can_frame, line, msg_kwargs)

    def _lenient(self, process: Callable[[str, Any], can.Message], line: str, msg_kwargs: Any) -> can.Message | None:
        try:
            return _complete(process(line, msg_kwargs), line)
        except (ValueError, IndexError) as error:
            self._skipped.add(error)
            return None


class _Trc(can.TRCReader):
    """A TRC file in which a line may be wrong, also of version 1.2, which python-can does not read."""

    def __init__(self, file: Any, skipped: Skipped, version: str) -> None:
        super().__init__(file)
        self._skipped = skipped
        self._version = version

    def _parse_line(self, line: str) -> can.Message | None:
        try:
            if self._version == "1.2":  # as 1.3, without the reserved column
                columns = line.split()
                return self._parse_cols_v1_3((*columns[:5], "-", *columns[5:]))
            message = self._parse_cols(tuple(line.split(maxsplit=self._num_columns)))
        except (ValueError, IndexError, KeyError) as error:
            self._skipped.add(ValueError(f"{line[:60]!r}: {error}") if line else error)
            return None
        return message


def _complete(message: can.Message, line: str) -> can.Message:
    """`message`, if it has all its data. Raises ValueError."""
    if not (message.is_remote_frame or message.is_error_frame) and len(message.data) != message.dlc:
        raise ValueError(f"{line.strip()[:60]!r}: {len(message.data)} bytes of {message.dlc}")
    return message


class _Lines(io.TextIOBase):
    """`lines` as an open file, for a reader that takes one line after the other: of a log none needs all at once."""

    def __init__(self, lines: Iterable[str]) -> None:
        self._lines = iter(lines)

    def readline(self, size: int = -1, /) -> str:  # type: ignore[override]  # IOBase's are bytes
        return next(self._lines, "")


def _begun(lines: Iterator[str]) -> tuple[str, Iterator[str]]:
    """The first lines, HEAD characters or a few more, and all lines."""
    head: list[str] = []
    size = 0
    while size < HEAD and (line := next(lines, "")):
        head.append(line)
        size += len(line)
    return "".join(head), chain(head, lines)


def _asc(path: Path, skipped: Skipped) -> Iterable[can.Message]:
    with open_text(path) as file:
        head, lines = _begun(re.sub(r"^(\s*\d+),(\d+\s)", r"\1.\2", line) for line in lines_of(file))  # decimal commas
        relative = re.search(r"^\s*base\s+\w+\s+timestamps\s+relative", head, re.IGNORECASE | re.MULTILINE)
        yield from _Asc(_Lines(_accumulated(lines) if relative else lines), skipped)


def _accumulated(lines: Iterable[str]) -> Iterator[str]:
    """The lines of an ASC file with times since the line before, with times since its beginning."""
    time = 0.0
    for line in lines:
        stamp = re.match(r"\s*(\d+\.\d+)(?=\s)", line)
        if stamp:
            time += float(stamp[1])
            line = f"{time:.9f}{line[stamp.end() :]}"
        yield line


def _trc(path: Path, skipped: Skipped) -> Iterable[can.Message]:
    commas = re.compile(r"^(;\$STARTTIME=\d+|\s*\d+\)?\s+\d+),(\d+)")  # as a computer set to German writes them
    with open_text(path) as file:
        head, lines = _begun(commas.sub(r"\1.\2", line) for line in lines_of(file))
        version = re.search(r"^;\$FILEVERSION=([\d.]+)", head, re.MULTILINE)
        yield from _Trc(_Lines(lines), skipped, version[1] if version else "1.0")


def _blf(path: Path, skipped: Skipped) -> Iterable[can.Message]:
    with path.open("rb") as file:
        yield from can.BLFReader(file)


def _csv(path: Path, skipped: Skipped) -> Iterable[can.Message]:
    with open_text(path) as file:
        reader = can.CSVReader(file)
        yield from reader


def _mf4(path: Path, skipped: Skipped) -> Iterable[can.Message]:
    with _mdf(path) as mdf:
        found = [
            each
            for group in _bus_groups(mdf)
            for name in ("CAN_DataFrame", "CAN_RemoteFrame")
            if name in {channel.name for channel in mdf.groups[group].channels}
            for each in _mf4_messages(mdf, group, name)
        ]
        start = mdf.header.start_time.timestamp()
    found.sort(key=lambda message: message.timestamp)
    for message in found:
        message.timestamp += start
        yield message


def _mf4_messages(mdf: Any, group: int, name: str) -> Iterator[can.Message]:
    for offset in range(0, mdf.groups[group].channel_group.cycles_nr, CHUNK):
        signal = mdf.get(name, group, record_offset=offset, record_count=CHUNK)
        fields = signal.samples.dtype.names or ()

        def field(key: str, default: int, signal: Any = signal, fields: Sequence[str] = fields) -> Any:
            whole = f"{name}.{key}"
            found = signal.samples[whole] if whole in fields else None
            return found if found is not None and found.dtype.kind != "S" else np.full(len(signal), default)

        data = field("DataBytes", 0)
        columns = (field("ID", 0), field("IDE", 0), field("BusChannel", 0), field("DLC", 0), field("DataLength", 8))
        for place, (can_id, extended, channel, dlc, length) in enumerate(zip(*columns, strict=True)):
            remote = name == "CAN_RemoteFrame"
            yield can.Message(
                timestamp=float(signal.timestamps[place]),
                arbitration_id=int(can_id) & 0x1FFFFFFF,
                is_extended_id=bool(extended) or int(can_id) > 0x7FF,
                is_remote_frame=remote,
                dlc=int(dlc) if remote else None,
                data=None if remote else bytes(np.atleast_1d(data[place])[: int(length)].tolist()),
                channel=int(channel),
            )


def _bus_groups(mdf: Any) -> list[int]:
    """The groups of an MF4 that hold frames."""
    names = {"CAN_DataFrame", "CAN_RemoteFrame"}
    return [place for place, group in enumerate(mdf.groups) if names & {channel.name for channel in group.channels}]


@contextmanager
def _mdf(path: Path) -> Iterator[Any]:
    """The file, without what asammdf prints and warns of. Raises RecordingError if asammdf is missing."""
    with quiet():
        try:
            with opened(path) as mdf:
                yield mdf
        except ModuleNotFoundError as error:
            raise missing(path, error) from error
        except Exception:
            collect()
            raise


def has_bus_events(path: Path) -> bool:
    """Whether an MF4 holds frames, and not signals alone. Raises RecordingError if asammdf is missing."""
    try:
        with _mdf(path) as mdf:
            return bool(_bus_groups(mdf))
    except RecordingError:
        raise
    except Exception:  # asammdf has exceptions of its own, which it does not export
        return False


READERS: dict[str, Callable[[Path, Skipped], Iterable[can.Message]]] = {
    "asc": _asc,
    "trc": _trc,
    "blf": _blf,
    "csv": _csv,
    "mf4": _mf4,
}
"""By the name of the format."""
