"""Messages of ROS 2 without ROS: a type of a header, numbers and texts, as its definition (.msg) and in CDR.

    std_msgs/Header header      # stamp: time of the data
    float64 NAME                # one of each number
    string NAME                 # one of each text

CDR in little endian (OMG DDSI-RTPS 2.5, section 10): four bytes of encapsulation, then the fields in their order, each
aligned to its size from there. With an empty `frame_id` the numbers begin at byte 16, which is aligned for float64.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence

PACKAGE = "upright_msgs"
ENCAPSULATION = b"\x00\x01\x00\x00"
NANOSECONDS = 1_000_000_000

_RULE = "=" * 80
_INCLUDED = f"""{_RULE}
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
{_RULE}
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
"""


class MessageType:
    """The type upright_msgs/msg/NAME. `numbers` and `texts` have the comment of each field by its name, in order."""

    def __init__(self, name: str, numbers: Mapping[str, str], texts: Mapping[str, str] | None = None) -> None:
        texts = texts or {}
        self.name = f"{PACKAGE}/msg/{name}"
        fields = [f"float64 {field}  # {comment}" for field, comment in numbers.items()]
        fields += [f"string {field}  # {comment}" for field, comment in texts.items()]
        self.definition = "\n".join(["std_msgs/Header header", *fields, _INCLUDED])
        self._fixed = struct.Struct(f"<4siII4x{len(numbers)}d")

    def encode(self, time_ns: int, numbers: Sequence[float], texts: Sequence[str] = ()) -> bytes:
        """The message of data of `time_ns`, ns since 1970. Raises struct.error if it is not one value a number."""
        seconds, nanoseconds = divmod(time_ns, NANOSECONDS)
        fixed = self._fixed.pack(ENCAPSULATION, seconds, nanoseconds, len(b"\0"), *numbers)
        return fixed + b"".join(map(_text, texts)) if texts else fixed


def _text(text: str) -> bytes:
    """A string, which ends with a zero, filled up to where the next one begins."""
    data = text.encode().replace(b"\0", b" ") + b"\0"
    return struct.pack("<I", len(data)) + data + bytes(-len(data) % 4)
