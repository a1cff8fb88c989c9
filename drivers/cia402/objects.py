"""Entries of the object dictionary that upright uses, with the types of CiA 301 and CiA 402."""

from __future__ import annotations

import struct
from dataclasses import dataclass

DATA_TYPES = {"b": 0x02, "h": 0x03, "i": 0x04, "B": 0x05, "H": 0x06, "I": 0x07}
"""struct format character to data type number of CiA 301 (INTEGER8 .. INTEGER32, UNSIGNED8 .. UNSIGNED32)."""


@dataclass(frozen=True, slots=True)
class ObjectEntry:
    """One entry of an object dictionary. `code` is its struct format character, little-endian on the bus."""

    name: str
    index: int
    subindex: int
    code: str

    @property
    def size(self) -> int:
        """Bytes."""
        return struct.calcsize("<" + self.code)

    @property
    def mapping(self) -> int:
        """The entry as it stands in a PDO mapping: index << 16 | subindex << 8 | bits."""
        return self.index << 16 | self.subindex << 8 | self.size * 8

    @property
    def data_type(self) -> int:
        """Data type number, as in an EDS."""
        return DATA_TYPES[self.code]

    def pack(self, value: int) -> bytes:
        """Raises struct.error if `value` does not fit."""
        return struct.pack("<" + self.code, value)

    def unpack(self, data: bytes) -> int:
        """Raises struct.error if `data` has another length."""
        value: int = struct.unpack("<" + self.code, data)[0]
        return value

    def __str__(self) -> str:
        return f"{self.name} ({self.index:04X}h:{self.subindex})"


DEVICE_TYPE = ObjectEntry("device type", 0x1000, 0, "I")
SYNC_COB_ID = ObjectEntry("COB-ID SYNC", 0x1005, 0, "I")
EMERGENCY_COB_ID = ObjectEntry("COB-ID EMCY", 0x1014, 0, "I")
CONSUMER_HEARTBEAT = ObjectEntry("consumer heartbeat time", 0x1016, 1, "I")
PRODUCER_HEARTBEAT = ObjectEntry("producer heartbeat time", 0x1017, 0, "H")
VENDOR_ID = ObjectEntry("vendor id", 0x1018, 1, "I")
PRODUCT_CODE = ObjectEntry("product code", 0x1018, 2, "I")
REVISION = ObjectEntry("revision number", 0x1018, 3, "I")
SERIAL_NUMBER = ObjectEntry("serial number", 0x1018, 4, "I")
ABORT_CONNECTION_OPTION = ObjectEntry("abort connection option code", 0x6007, 0, "h")
ERROR_CODE = ObjectEntry("error code", 0x603F, 0, "H")
CONTROLWORD = ObjectEntry("controlword", 0x6040, 0, "H")
STATUSWORD = ObjectEntry("statusword", 0x6041, 0, "H")
QUICK_STOP_OPTION = ObjectEntry("quick stop option code", 0x605A, 0, "h")
MODE = ObjectEntry("modes of operation", 0x6060, 0, "b")
MODE_DISPLAY = ObjectEntry("mode_display", 0x6061, 0, "b")
INTERPOLATION_TIME = ObjectEntry("interpolation time period", 0x60C2, 1, "B")
INTERPOLATION_EXPONENT = ObjectEntry("interpolation time index", 0x60C2, 2, "b")
SUPPORTED_MODES = ObjectEntry("supported drive modes", 0x6502, 0, "I")
