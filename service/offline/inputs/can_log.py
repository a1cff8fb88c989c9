"""CAN logs: candump (can-utils), ASC and BLF (Vector), TRC (PEAK), MF4 bus logging (ASAM) and CSV (python-can).

Which one a file is, is found by its content. `service.offline.inputs.can_readers` reads those of other tools, with
python-can and, for MF4, asammdf (the extra `upright[mf4]`). A line that is no frame is left out and counted.
"""

from __future__ import annotations

import csv
import logging
import re
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from itertools import chain, islice
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

from upright.drivers.vehicle_io import VehicleIo
from upright.telemetry.candump import UNREADABLE, CandumpReader, Skipped, open_text, parse_line, unreadable
from upright.telemetry.errors import RecordingError
from upright.telemetry.recording import FARTHEST
from upright.telemetry.samples import CanFrame
from upright.vehicles.sections import VehicleFile

if TYPE_CHECKING:
    import can

SUFFIXES = (".log", ".asc", ".blf", ".trc")
"""Of CAN logs; a log with another suffix is recognised by its content."""

CANDUMP = "candump"
"""The format that `telemetry.candump` reads."""

TABLES = (".arrow", ".parquet", ".feather")
"""Suffixes of files in which no CAN log is looked for."""

HEAD = 4096
"""Characters at the beginning of a file from which is found what it is."""

MOST_IDS = 8
"""Ids of a log that an error names."""

LOOK = 5000
"""Frames from which is found on which interfaces a vehicle is."""


class CanLog(Protocol):
    """A CAN log: its frames, in order, with the index of each interface in `buses`. `truncated` states afterwards what
    was left out and what was assumed. Raises RecordingError."""

    buses: dict[str, int]

    @property
    def truncated(self) -> str: ...
    def __iter__(self) -> Iterator[CanFrame]: ...


def open_log(path: Path) -> CanLog:
    """The log in a file. Raises RecordingError if it cannot be opened."""
    try:
        kind = _format(path)
    except UNREADABLE as error:
        raise unreadable(path, error) from error
    if kind in ("", CANDUMP):
        return CandumpReader(path)
    from upright.service.offline.inputs.can_readers import READERS

    return MessageLog(path, READERS[kind])


def is_can_log(path: Path) -> bool:
    """Whether a file is a CAN log, by its suffix or, if that is another, by its content."""
    path = Path(path)
    if path.suffix in TABLES:
        return False
    try:
        kind = _format(path)
    except UNREADABLE:
        kind = ""
    if kind == "mf4":
        from upright.service.offline.inputs.can_readers import has_bus_events

        with _quiet():
            return has_bus_events(path)
    return bool(kind) or path.suffix.lower() in SUFFIXES


def of_vehicle(log: CanLog, io: VehicleIo, vehicle: VehicleFile, notes: list[str]) -> Iterator[CanFrame]:
    """The frames of the interfaces that the vehicle is on, if the log has several.

    Where the ids of the drives, or of the IMU, come from several interfaces, that of the vehicle file is taken, or else
    the one with the most of them; `notes` then gets a sentence.
    """
    frames = iter(log)
    first = list(islice(frames, LOOK))
    chosen: dict[int, int] = {}
    of_imu = frozenset(io.imu.can_ids)
    of_drives = frozenset(io.can_ids) - of_imu
    for what, ids, address in (("drives", of_drives, vehicle.bus.drives), ("imu", of_imu, vehicle.bus.imu)):
        heard = Counter(frame.bus for frame in first if frame.can_id in ids and not frame.extended)
        if len(heard) > 1:
            names = {place: name for name, place in log.buses.items()}
            named = log.buses.get(address.partition(":")[2])
            bus = named if named in heard and named is not None else heard.most_common(1)[0][0]
            chosen.update(dict.fromkeys(ids, bus))
            others = ", ".join(names[place] for place in heard if place != bus)
            notes.append(f"the ids of bus.{what} are on {names[bus]} and {others}: {names[bus]} is read")
    for frame in chain(first, frames):
        if chosen.get(frame.can_id, frame.bus) == frame.bus:
            yield frame


def ids(log: CanLog) -> str:
    """The ids in a log, the most frequent ones first, in words."""
    found = Counter(f"{frame.can_id:03X}h" for frame in islice(log, LOOK) if not frame.error)
    more = f" and {len(found) - MOST_IDS} more" if len(found) > MOST_IDS else ""
    return f"the ids {', '.join(name for name, _ in found.most_common(MOST_IDS))}{more}" if found else "no frames"


class MessageLog:
    """A log that python-can or asammdf reads."""

    def __init__(self, path: Path, reader: Callable[[Path, Skipped], Iterable[can.Message]]) -> None:
        self.path = path
        self.buses: dict[str, int] = {}
        self._reader = reader
        self._skipped = Skipped()
        self._ended = ""

    @property
    def truncated(self) -> str:
        return "; ".join(filter(None, (self._ended, self._skipped.words)))

    def __iter__(self) -> Iterator[CanFrame]:
        self._skipped, self._ended = Skipped(), ""
        latest: int | None = None
        with _quiet():
            try:
                for message in self._reader(self.path, self._skipped):
                    if not abs(message.timestamp) < 1e-9 * FARTHEST:
                        what = f"a frame at {message.timestamp:.6g} s, which is no time of this century"
                        self._skipped.add(ValueError(what))
                        continue
                    frame = self._frame(message)
                    latest = frame.timestamp_ns
                    yield frame
            except RecordingError:
                raise
            except OSError as error:
                raise unreadable(self.path, error) from error
            except Exception as error:  # the readers fail in many ways where a file is not what it claims to be
                if latest is None:
                    raise RecordingError(
                        str(self.path),
                        "",
                        f"is no CAN log that can be read ({type(error).__name__}: {error})",
                        remedy="Export it again from the tool that wrote it, or as `candump -L` writes it.",
                    ) from error
                self._ended = f"it cannot be read to its end ({type(error).__name__}: {error}): the rest was left out"
        if latest is None:
            skipped = f": {self._skipped.first}" if self._skipped.count else ""
            raise RecordingError(
                str(self.path), "", f"holds no CAN frame{skipped}", remedy="Check that it is a log of the CAN bus."
            )

    def _frame(self, message: can.Message) -> CanFrame:
        channel = message.channel
        name = f"can{channel}" if isinstance(channel, int) else str(channel or "can0")
        return CanFrame(
            round(message.timestamp * 1e9),
            message.arbitration_id,
            bytes(message.dlc) if message.is_remote_frame else bytes(message.data),
            self.buses.setdefault(name, len(self.buses)),
            extended=message.is_extended_id and not message.is_error_frame,
            remote=message.is_remote_frame,
            error=message.is_error_frame,
        )


def _format(path: Path) -> str:
    """What a file is, by its content: "asc", "trc", "blf", "csv", "mf4" or CANDUMP; "" if it is no CAN log.

    Raises one of UNREADABLE.
    """
    with path.open("rb") as binary:
        start = binary.read(8)
    if start.startswith(b"LOGG"):
        return "blf"
    if start.startswith((b"MDF ", b"UnFinMF")):
        return "mf4"
    with open_text(path) as file:
        head = file.read(HEAD)
    if re.search(r"^\s*base\s+(hex|dec)\b", head, re.IGNORECASE | re.MULTILINE):
        return "asc"
    if re.search(r"^;.*(\$FILEVERSION|PCAN|PEAK)", head, re.IGNORECASE | re.MULTILINE):
        return "trc"
    lines = head.splitlines()
    if lines and {"timestamp", "arbitration_id", "data"} <= set(next(csv.reader(lines[:1]), [])):
        return "csv"
    for line in lines[:-1]:
        with suppress(ValueError):
            parse_line(line, {})
            return CANDUMP
    return ""


class _quiet:
    """What the readers log for their developers does not reach the user."""

    def __enter__(self) -> None:
        self._levels = [(logging.getLogger(name), logging.getLogger(name).level) for name in ("can", "asammdf")]
        for logger, _ in self._levels:
            logger.setLevel(logging.CRITICAL)

    def __exit__(self, *_: object) -> None:
        for logger, level in self._levels:
            logger.setLevel(level)
