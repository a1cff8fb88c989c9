"""CAN logs as text, written by upright and by `candump` (can-utils), python-can and their relatives.

Written is the format of `candump -L`, with nanoseconds:

    (1730301035.277560123) can0 18A#00112233

An extended id has eight hex digits, a remote frame `R` and its length in place of data, an error frame the flag
20000000h in its id (linux/can/error.h). Read are also its dialects: any number of decimals, a trailing direction (`R`,
`T`), CAN FD (`##` and a digit of flags), raw length codes (`_B`), dots between bytes, and what `candump` shows on a
screen:

     (1730301035.277560)  can0  RX B -  18A   [4]  00 11 22 33   '..."3'

and what python-can prints:

    Timestamp: 1730301035.277560    ID:      18a    S Rx                DL:  4    00 11 22 33    Channel: can0

Times are absolute, from the start, between two frames (`-td`), or a date. Lines that are no frame are counted.
"""

from __future__ import annotations

import codecs
import gzip
import re
import zlib
from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from datetime import UTC, datetime
from decimal import Decimal, InvalidOperation
from itertools import chain, islice, pairwise
from pathlib import Path
from typing import TextIO, cast

from upright.telemetry.errors import RecordingError
from upright.telemetry.samples import CanFrame

ERROR_FLAG = 0x20000000
EXTENDED_MASK = 0x1FFFFFFF
STANDARD_MASK = 0x7FF
LENGTHS = frozenset((*range(9), 12, 16, 20, 24, 32, 48, 64))
"""Data bytes that a frame can have; more than eight are CAN FD's."""

STEP_NS = 128_000_000
"""Time by which the clock of a log must go back for it to have been set: smaller offsets ntpd removes slowly, and
frames of several interfaces, or of several senders, are out of order by less."""

DIGITS = 11
"""Of the seconds of a time, at most: with one more it is later than the year 5138."""

LOOK = 1000
"""Frames from which is found out whether times are between two frames."""

LONGEST = 10_000
"""Characters of a line that are looked at; one of CAN FD, shown in bits, has some 700."""

UNREADABLE = (OSError, EOFError, zlib.error)
"""What reading from `open_text` raises: of a compressed log that is cut off or damaged, too."""

RECENT = 256
"""Frames from which is found out when the next one of an id is due."""

COMMENTS = ("#", "//", ";", "*")

LOGGED = re.compile(
    r"\s*\(?(?P<stamp>[\d.eE:+-]+(?:[ T][\d:.]+)?)\)?\s+(?P<channel>\S+)\s+(?P<id>[0-9A-Fa-f]{1,8})#(?P<content>\S*)"
)
SHOWN = re.compile(
    r"\s*(?:\((?P<stamp>[^)]*)\)\s+)?(?P<channel>\S+)\s+(?:[RT]X\s+\S+\s+\S+\s+)?(?P<id>[0-9A-Fa-f]{3}|[0-9A-Fa-f]{8})"
    r"\s+[\[{]\s*(?P<length>[0-9A-Fa-f]+)\s*[\]}](?P<content>.*)"
)
PRINTED = re.compile(
    r"\s*Timestamp:\s*(?P<stamp>\S+)\s+ID:\s*(?P<id>[0-9A-Fa-f]{3}|[0-9A-Fa-f]{8})\s+[SX] [RT]x(?P<flags>[ERFBSI ]*)"
    r"DL:\s*(?P<length>\d+)\s+(?P<content>.*?)(?:\s+Channel:\s*(?P<channel>\S+))?\s*$"
)
COLOURS = re.compile(r"\x1b\[[0-9;]*m")
BYTES = re.compile(r"(?:[0-9A-Fa-f]{2}|[01]{8})(?:(?: +|`)(?:[0-9A-Fa-f]{2}|[01]{8}))*(?= |$)")


class Untimed(ValueError):
    """A frame without a time."""


class Skipped:
    """The lines of a log that are no frame: how many, and what is wrong with the first."""

    def __init__(self) -> None:
        self.count = 0
        self.first = ""
        self.line = 0
        self.untimed = False

    def add(self, error: Exception, line: int = 0) -> None:
        """Count one. `line` is its number, 0 if that is not known."""
        self.untimed = self.untimed or isinstance(error, Untimed)
        if not self.count:
            self.first, self.line = str(error), line
        self.count += 1

    @property
    def words(self) -> str:
        """A note for the user, "" if there is none to make."""
        if not self.count:
            return ""
        place = f"line {self.line}: " if self.line else ""
        what = "1 line is no CAN frame and was" if self.count == 1 else f"{self.count} lines are no CAN frames and were"
        return f"{what} left out ({'' if self.count == 1 else 'the first: '}{place}{self.first})"


def format_frame(frame: CanFrame, channel: str) -> str:
    """One line, without its end."""
    if frame.error:
        can_id = f"{frame.can_id | ERROR_FLAG:08X}"
    else:
        can_id = f"{frame.can_id:08X}" if frame.extended else f"{frame.can_id:03X}"
    data = f"R{len(frame.data) or ''}" if frame.remote else frame.data.hex().upper()
    seconds, nanoseconds = divmod(frame.timestamp_ns, 1_000_000_000)
    return f"({seconds:010d}.{nanoseconds:09d}) {channel} {can_id}#{data}"


def format_frames(frames: Iterable[CanFrame], channels: Sequence[str]) -> str:
    """Whole lines; `channels` names the buses by their index."""
    return "".join(f"{format_frame(frame, channels[frame.bus])}\n" for frame in frames)


def parse_line(line: str, buses: dict[str, int]) -> CanFrame:
    """The frame of one line. `buses` gives the index of a channel; new channels are added to it.

    Raises ValueError, whose text states the error.
    """
    if (found := LOGGED.match(line)) is not None:
        stamp, channel, digits, content = found.groups()
        data, remote = _logged_data(content)
    elif (found := SHOWN.match(line) or PRINTED.match(line)) is not None:
        stamp, channel, digits, length, content = found.group("stamp", "channel", "id", "length", "content")
        data, remote = _shown_data(content, length)
        if "R" in found.groupdict().get("flags", ""):
            data, remote = bytes(int(length)), True
    else:
        raise ValueError(f"not a CAN frame: {line.strip()[:60]!r}")
    if stamp is None:
        raise Untimed("a frame without a time")
    timestamp_ns = parse_time(stamp)
    if len(data) not in LENGTHS:
        raise ValueError(f"a frame of {len(data)} bytes")
    can_id = int(digits, 16)
    extended = len(digits) > 3
    if can_id > (EXTENDED_MASK | ERROR_FLAG if extended else STANDARD_MASK):
        raise ValueError(f"{digits} is not a CAN id")
    bus = buses.setdefault(channel or "", len(buses))
    if extended and can_id & ERROR_FLAG:
        return CanFrame(timestamp_ns, can_id & EXTENDED_MASK, data, bus, False, False, True)
    return CanFrame(timestamp_ns, can_id, data, bus, extended, remote)


def parse_time(text: str) -> int:
    """ns of a time in s, with any number of decimals, or of a date (UTC if it names no zone). Raises ValueError."""
    seconds, _, fraction = text.partition(".")
    if len(seconds) <= DIGITS and seconds.isdecimal() and (fraction.isdecimal() or not fraction):
        return int(seconds) * 1_000_000_000 + int(fraction[:9].ljust(9, "0"))
    with suppress(InvalidOperation):
        number = Decimal(text)
        if not abs(number) < 10**DIGITS:
            raise ValueError(f"no time of this century: {text[:40]!r}")
        return int(number * 1_000_000_000)
    try:
        date = datetime.fromisoformat(text)
    except ValueError:
        raise ValueError(f"no time: {text[:40]!r}") from None
    whole = date.replace(microsecond=0, tzinfo=date.tzinfo or UTC)
    return round(whole.timestamp()) * 1_000_000_000 + date.microsecond * 1000


def _logged_data(content: str) -> tuple[bytes, bool]:
    """Data of a frame as a log has it, and whether it is a remote frame, with its length in zeros."""
    with suppress(ValueError):
        return bytes.fromhex(content), False
    if content[:1] == "#":  # CAN FD: a digit of flags
        content = content[2:]
    elif content[:1] in ("R", "r"):
        length = content[1:].partition("_")[0]
        if length and not (length.isdecimal() and int(length) <= 8):
            raise ValueError(f"a remote frame of {length[:12]} bytes")
        return bytes(int(length or "0")), True
    return bytes.fromhex(content.partition("_")[0].replace(".", "")), False


def _shown_data(content: str, length: str) -> tuple[bytes, bool]:
    """The same of a frame as `candump` shows it."""
    size = int(length, 10 if length.isdecimal() else 16)
    content = content.strip()
    if content.lower().startswith("remote request"):
        return bytes(size if size <= 8 else 0), True
    found = BYTES.match(content)
    swapped = found is not None and "`" in found[0]
    words = found[0].replace("`", " ").split() if found is not None else []
    data = bytes(int(word, 2 if len(word) == 8 else 16) for word in words)[:size]
    if len(data) < min(size, 8):
        raise ValueError(f"{len(data)} bytes of {size}")
    return data[::-1] if swapped else data, False


class CandumpReader:
    """The frames of a log file, in its order.

    What is no frame is left out and counted; so is a last line that was cut off (by a crash). `truncated` states it,
    with everything else that was assumed. `buses` gives the index of each channel name, in the order of appearance.
    Raises RecordingError, with the line number, if no line is a frame.
    """

    def __init__(self, path: Path) -> None:
        self.path = Path(path)
        self.buses: dict[str, int] = {}
        self._notes: list[str] = []
        self._skipped = Skipped()

    @property
    def truncated(self) -> str:
        """What was left out and what was assumed, in words; "" if that is nothing."""
        return "; ".join(filter(None, (*self._notes, self._skipped.words)))

    def __iter__(self) -> Iterator[CanFrame]:
        self._notes, self._skipped = [], Skipped()
        try:
            with open_text(self.path) as file:
                frames = self._parsed(file)
                first = list(islice(frames, LOOK))
                if not first and self._skipped.count:
                    raise self._no_frames()
                timed = self._accumulated if _are_differences(first) else self._continued
                yield from timed(chain(first, frames))
        except UNREADABLE as error:
            raise unreadable(self.path, error) from error

    def _parsed(self, file: TextIO) -> Iterator[CanFrame]:
        for number, line in enumerate(lines_of(file), start=1):
            if not line.endswith("\n"):
                # Even if it parses, its last data bytes may be missing.
                self._notes.append(f"line {number} is cut off and was left out")
            elif not line.isspace() and not line.lstrip().startswith(COMMENTS):
                try:
                    yield parse_line(COLOURS.sub("", line) if "\x1b" in line else line, self.buses)
                except ValueError as error:
                    self._skipped.add(error, number)

    def _no_frames(self) -> RecordingError:
        if self._skipped.untimed:
            what, remedy = "its frames have no times", "Record it again with them: `candump -L can0 > run.log`."
            return RecordingError(str(self.path), "", what, remedy=remedy)
        return RecordingError(
            str(self.path),
            f"line {self._skipped.line}",
            f"no line is a CAN frame: {self._skipped.first}",
            remedy="Expected lines as `candump -L` writes them: (1730301035.277560) can0 18A#0011.",
        )

    def _accumulated(self, frames: Iterable[CanFrame]) -> Iterator[CanFrame]:
        """Frames whose times are those since the frame before."""
        self._notes.append("its times are those between two frames (candump -td): they were added up")
        time_ns = 0
        for frame in frames:
            time_ns += frame.timestamp_ns
            yield _at(frame, time_ns)

    def _continued(self, frames: Iterator[CanFrame]) -> Iterator[CanFrame]:
        """Frames whose times go on when the clock was set back, and end where another log begins.

        A single frame with a time of its own is left out.
        """
        ahead = _Ahead(frames)
        recent: deque[CanFrame] = deque(maxlen=RECENT)
        latest: dict[int, int] = {}
        start: int | None = None
        shift = 0
        for frame in ahead:
            start = frame.timestamp_ns if start is None else start
            before = latest.get(frame.bus)
            stamp = frame.timestamp_ns + shift
            if before is not None and abs(stamp - before) > STEP_NS:
                after = ahead.next_of(frame.bus)
                if after is not None and _is_alone(before, stamp, after.timestamp_ns + shift):
                    self._skipped.add(ValueError(f"a frame {frame.can_id:03X}h {(stamp - before) * 1e-9:+.3f} s away"))
                    continue
                if stamp < before and frame.timestamp_ns <= start:
                    self._notes.append(
                        f"after {(before - start) * 1e-9:.3f} s its times begin again: what follows is another "
                        "recording and was left out (split the file to use it)"
                    )
                    return
                if stamp < before:
                    back = max(before, _expected(frame, recent)) - stamp
                    shift += back
                    stamp += back
                    self._notes.append(
                        f"its clock was set back by {back * 1e-9:.3f} s after {(before - start) * 1e-9:.3f} s:"
                        " the times go on from there"
                    )
            latest[frame.bus] = stamp
            timed = frame if not shift else _at(frame, stamp)
            recent.append(timed)
            yield timed


class _Ahead:
    """Frames of which later ones can be seen before their turn."""

    def __init__(self, frames: Iterator[CanFrame]) -> None:
        self._frames = frames
        self._waiting: deque[CanFrame] = deque()

    def __iter__(self) -> Iterator[CanFrame]:
        while True:
            if self._waiting:
                yield self._waiting.popleft()
            elif (frame := next(self._frames, None)) is not None:
                yield frame
            else:
                return

    def next_of(self, bus: int) -> CanFrame | None:
        """The next frame of a bus, if it is one of the next ones."""
        self._waiting.extend(islice(self._frames, max(0, LOOK - len(self._waiting))))
        return next((frame for frame in self._waiting if frame.bus == bus), None)


def _is_alone(before: int, stamp: int, after: int) -> bool:
    """Whether one time is off, and the next one is as if it had not been."""
    goes_on = after >= before - STEP_NS
    return goes_on and (stamp < before - STEP_NS or after < stamp - STEP_NS)


def _expected(frame: CanFrame, recent: Iterable[CanFrame]) -> int:
    """When a frame that comes at regular intervals is due, ns; 0 if it has not come twice."""
    stamps = [each.timestamp_ns for each in recent if (each.bus, each.can_id) == (frame.bus, frame.can_id)]
    return 2 * stamps[-1] - stamps[-2] if len(stamps) > 1 else 0


def lines_of(file: TextIO) -> Iterator[str]:
    """The lines; of one that is longer than LONGEST, its beginning."""
    while line := file.readline(LONGEST):
        rest = line
        while len(rest) == LONGEST and not rest.endswith("\n"):
            rest = file.readline(LONGEST)
        yield line if rest is line else f"{line}\n"


def unreadable(path: Path, error: Exception) -> RecordingError:
    """That a log cannot be read, for one of the reasons in UNREADABLE."""
    why = getattr(error, "strerror", None) or str(error)
    remedy = "Check the path and its permissions."
    if not isinstance(error, OSError) or isinstance(error, gzip.BadGzipFile):
        remedy = "Copy it again; of one that was cut off, `zcat FILE > run.log` gives what can be read."
    return RecordingError(str(path), "", f"cannot be read: {why}", remedy=remedy)


def open_text(path: Path) -> TextIO:
    """A log in UTF-8, ASCII or UTF-16, with or without the mark at its beginning, or compressed by gzip.

    Bytes that are no text are replaced. Raises one of UNREADABLE, and so does reading from it.
    """
    with path.open("rb") as file:
        opener = gzip.open if file.read(2) == b"\x1f\x8b" else open
    with opener(path, "rb") as binary:
        encoding = _encoding(binary.read(4))
    return cast(TextIO, opener(path, "rt", encoding=encoding, errors="replace"))


def _encoding(head: bytes) -> str:
    if head.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        return "utf-16"
    if len(head) == 4 and head[1] == head[3] == 0 and head[0] and head[2]:
        return "utf-16-le"
    if len(head) == 4 and head[0] == head[2] == 0 and head[1] and head[3]:
        return "utf-16-be"
    return "utf-8-sig"


def _at(frame: CanFrame, timestamp_ns: int) -> CanFrame:
    return CanFrame(timestamp_ns, frame.can_id, frame.data, frame.bus, frame.extended, frame.remote, frame.error)


def _are_differences(frames: Sequence[CanFrame]) -> bool:
    """Whether the times are those since the frame before: they fall as much as they rise, and often.

    Absolute times rise, but for frames that are a little out of order, and for a clock that is set back once.
    """
    steps = [later.timestamp_ns - earlier.timestamp_ns for earlier, later in pairwise(frames)]
    falls = [-step for step in steps if step < 0]
    often = len(falls) > max(2, len(steps) // 64)
    return often and 2 * sum(falls) > sum(step for step in steps if step > 0)
