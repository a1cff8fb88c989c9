"""Raw CAN logs in the format of `candump -L` (can-utils), with nanoseconds:

    (1730301035.277560123) can0 18A#00112233

An extended id has eight hex digits, a remote frame `R` and its length in place of data, an error frame the flag
20000000h in its id (linux/can/error.h). Nine decimals are written; six (microseconds) and nine are read.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

from telemetry.errors import RecordingError
from telemetry.samples import CanFrame

ERROR_FLAG = 0x20000000
EXTENDED_MASK = 0x1FFFFFFF


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
    stamp, channel, content = line.split()
    if stamp[0] != "(" or stamp[-1] != ")":
        raise ValueError(f"no time stamp in brackets: {stamp!r}")
    seconds, _, fraction = stamp[1:-1].partition(".")
    if len(fraction) not in (6, 9):
        raise ValueError(f"a time stamp has 6 or 9 decimals, not {len(fraction)}")
    timestamp_ns = int(seconds) * 1_000_000_000 + int(fraction) * (1 if len(fraction) == 9 else 1000)
    digits, separator, data = content.partition("#")
    if not separator or len(digits) not in (3, 8):
        raise ValueError(f"neither a standard nor an extended CAN frame: {content!r}")
    if data.startswith("#"):
        raise ValueError("CAN FD frames are not supported")
    can_id = int(digits, 16)
    bus = buses.setdefault(channel, len(buses))
    extended = len(digits) == 8
    remote = data[:1] == "R"
    length = int(data[1:] or "0") if remote else len(data) // 2
    if not 0 <= length <= 8:
        raise ValueError(f"a frame of {length} bytes")
    if remote:
        return CanFrame(timestamp_ns, can_id, bytes(length), bus, extended, True)
    payload = bytes.fromhex(data)
    if extended and can_id & ERROR_FLAG:
        return CanFrame(timestamp_ns, can_id & EXTENDED_MASK, payload, bus, False, False, True)
    return CanFrame(timestamp_ns, can_id, payload, bus, extended)


class CandumpReader:
    """The frames of a log file, in its order.

    A last line that was cut off (by a crash) is left out; `truncated` then states which. `buses` gives the index of
    each channel name, in the order of appearance. Raises RecordingError, with the line number, for an invalid line.
    """

    def __init__(self, path: Path) -> None:
        self.path = Path(path)
        self.buses: dict[str, int] = {}
        self.truncated = ""

    def __iter__(self) -> Iterator[CanFrame]:
        buses = self.buses
        number = 0
        try:
            with self.path.open(encoding="ascii", errors="replace") as file:
                for number, line in enumerate(file, start=1):
                    if not line.endswith("\n"):
                        # Even if it parses, its last data bytes may be missing.
                        self.truncated = f"line {number} is cut off and was left out"
                    elif not line.isspace():
                        yield parse_line(line, buses)
        except ValueError as error:
            raise RecordingError(
                str(self.path),
                f"line {number}",
                str(error),
                remedy="Expected lines as `candump -L` writes them: (1730301035.277560) can0 18A#0011.",
            ) from error
        except OSError as error:
            raise RecordingError(
                str(self.path), "", f"cannot be read: {error.strerror}", remedy="Check the path and its permissions."
            ) from error
