"""EMCY objects (CiA 301, 7.2.7): error code, error register (1001h) and five vendor-specific bytes, in words.

Codes are those of CiA 301 and CiA 402 (603Fh). A code that is not in the table is named by its class: the entry with
the most leading digits in common.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass

LENGTH = 8

ERROR_CODES: dict[int, str] = {
    0x0000: "no error",
    0x1000: "generic error",
    0x2000: "current",
    0x2100: "current on the input side",
    0x2200: "current inside the device",
    0x2300: "current on the output side",
    0x2310: "continuous over-current",
    0x2320: "short circuit or earth leakage",
    0x2330: "earth leakage",
    0x2340: "short circuit",
    0x3000: "voltage",
    0x3100: "mains voltage",
    0x3110: "mains over-voltage",
    0x3120: "mains under-voltage",
    0x3130: "mains phase failure",
    0x3200: "DC link voltage",
    0x3210: "DC link over-voltage",
    0x3220: "DC link under-voltage",
    0x3300: "output voltage",
    0x4000: "temperature",
    0x4100: "ambient temperature",
    0x4200: "device temperature",
    0x4210: "device over-temperature",
    0x4220: "device under-temperature",
    0x4300: "drive temperature",
    0x4310: "drive over-temperature",
    0x5000: "device hardware",
    0x5100: "device supply",
    0x5200: "control hardware",
    0x5300: "operating unit",
    0x5400: "power section",
    0x5441: "safe torque off",
    0x5500: "data storage",
    0x6000: "device software",
    0x6100: "internal software, watchdog",
    0x6200: "user software",
    0x6300: "data record",
    0x6320: "parameter error",
    0x7000: "additional modules",
    0x7100: "power stage module",
    0x7120: "motor",
    0x7121: "motor blocked",
    0x7122: "motor error or commutation malfunction",
    0x7200: "measurement circuit",
    0x7300: "sensor",
    0x7303: "resolver 1",
    0x7304: "resolver 2",
    0x7305: "incremental encoder 1",
    0x7306: "incremental encoder 2",
    0x7310: "speed",
    0x7320: "position",
    0x7400: "computation circuit",
    0x7500: "communication module",
    0x7600: "data storage module",
    0x8000: "monitoring",
    0x8100: "communication",
    0x8110: "CAN overrun, frames lost",
    0x8120: "CAN in error passive",
    0x8130: "heartbeat or life guard lost",
    0x8140: "recovered from bus-off",
    0x8150: "CAN id collision",
    0x8200: "protocol",
    0x8210: "PDO not processed, length wrong",
    0x8220: "PDO length exceeded",
    0x8240: "unexpected SYNC length",
    0x8250: "RPDO timeout",
    0x8300: "torque control",
    0x8311: "excess torque",
    0x8400: "speed controller",
    0x8500: "position controller",
    0x8600: "positioning",
    0x8611: "following error",
    0x8612: "reference limit",
    0x8700: "sync controller",
    0x8800: "winding controller",
    0x8900: "process data monitoring",
    0x9000: "external error",
    0xF000: "additional functions",
    0xF001: "deceleration",
    0xF002: "sub-synchronous run",
    0xF003: "stroke operation",
    0xF004: "control",
    0xFF00: "vendor-specific",
}

ERROR_REGISTER_BITS = (
    "generic",
    "current",
    "voltage",
    "temperature",
    "communication",
    "device profile",
    "reserved",
    "vendor-specific",
)
"""Meaning of the bits of 1001h, from bit 0."""

_LAYOUT = struct.Struct("<HB5s")


@dataclass(frozen=True, slots=True)
class Emergency:
    """One EMCY as received. `vendor` is the vendor's five bytes."""

    timestamp_ns: int
    code: int
    error_register: int
    vendor: bytes

    @property
    def cleared(self) -> bool:
        """The drive reports that all its errors are cleared."""
        return self.code == 0

    @property
    def text(self) -> str:
        """`8130h heartbeat or life guard lost (error register: communication; vendor bytes 0000000000)`."""
        register = ", ".join(register_bits(self.error_register)) or "clear"
        return f"{describe(self.code)} (error register: {register}; vendor bytes {self.vendor.hex()})"


def decode(timestamp_ns: int, data: bytes) -> Emergency:
    """Read the 8 bytes of an EMCY frame.

    Raises:
        struct.error: `data` has another length.
    """
    return Emergency(timestamp_ns, *_LAYOUT.unpack(data))


def describe(code: int) -> str:
    """An error code in words, by the closest known class: `7305h incremental encoder 1`."""
    for mask in (0xFFFF, 0xFFF0, 0xFF00, 0xF000):
        text = ERROR_CODES.get(code & mask)
        if text is not None and (code == 0 or code & mask):
            return f"{code:04X}h {text}"
    return f"{code:04X}h unknown error"


def of_communication(code: int) -> bool:
    """Whether an error code says that the drive has missed its master: heartbeat, setpoints or SYNC (81xxh, 82xxh)."""
    return code & 0xFF00 in (0x8100, 0x8200)


def register_bits(error_register: int) -> tuple[str, ...]:
    """Names of the bits that are set in an error register (1001h)."""
    return tuple(name for bit, name in enumerate(ERROR_REGISTER_BITS) if error_register >> bit & 1)
