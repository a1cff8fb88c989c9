"""CAN error frames of SocketCAN, decoded (linux/can/error.h).

A controller reports trouble on the wire as a frame whose id is a set of error classes and whose 8 data bytes hold the
details: [0] bit of a lost arbitration, [1] controller state, [2] kind and [3] place of a protocol violation,
[4] transceiver, [6] and [7] the transmit and receive error counters of ISO 11898-1 (96: warning, 128: error-passive,
256: bus-off, where the controller takes no further part in the bus).
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum, IntFlag

from upright.telemetry.samples import CanFrame


class ErrorClass(IntFlag):
    """What an error frame reports: the bits of its id."""

    TRANSMIT_TIMEOUT = 0x001
    LOST_ARBITRATION = 0x002
    CONTROLLER = 0x004
    PROTOCOL = 0x008
    TRANSCEIVER = 0x010
    NO_ACKNOWLEDGE = 0x020
    BUS_OFF = 0x040
    BUS_ERROR = 0x080
    RESTARTED = 0x100
    COUNTERS = 0x200


class ControllerState(Enum):
    """Fault confinement state of ISO 11898-1, as far as an error frame reports it."""

    ERROR_ACTIVE = "error-active"
    WARNING = "error warning"
    PASSIVE = "error-passive"
    BUS_OFF = "bus-off"
    UNKNOWN = "unknown"


@dataclass(frozen=True, slots=True)
class ErrorReport:
    """One error frame in words: `text` for a person, the rest for a program. Counters are None if not reported."""

    classes: ErrorClass
    state: ControllerState
    text: str
    transmit_errors: int | None
    receive_errors: int | None


CLASS_TEXTS = {
    ErrorClass.TRANSMIT_TIMEOUT: "transmit timeout",
    ErrorClass.TRANSCEIVER: "transceiver fault",
    ErrorClass.NO_ACKNOWLEDGE: "no acknowledge (no other node hears this one: cable, termination or bit rate)",
    ErrorClass.BUS_OFF: "bus-off",
    ErrorClass.BUS_ERROR: "bus error",
    ErrorClass.RESTARTED: "controller restarted",
}
CONTROLLER_TEXTS = {
    0x01: "receive buffer overflow",
    0x02: "transmit buffer overflow",
    0x04: "receive error warning",
    0x08: "transmit error warning",
    0x10: "receive error-passive",
    0x20: "transmit error-passive",
    0x40: "back to error-active",
}
VIOLATION_TEXTS = {
    0x01: "bit error",
    0x02: "form error",
    0x04: "bit stuffing error",
    0x08: "dominant bit not sent",
    0x10: "recessive bit not sent",
    0x20: "bus overload",
    0x40: "active error announced",
    0x80: "while transmitting",
}
LOCATION_TEXTS = {
    0x02: "id bits 28 to 21",
    0x03: "start of frame",
    0x04: "substitute remote request bit",
    0x05: "identifier extension bit",
    0x06: "id bits 20 to 18",
    0x07: "id bits 17 to 13",
    0x08: "checksum",
    0x09: "reserved bit 0",
    0x0A: "data",
    0x0B: "data length code",
    0x0C: "remote request bit",
    0x0D: "reserved bit 1",
    0x0E: "id bits 4 to 0",
    0x0F: "id bits 12 to 5",
    0x12: "intermission",
    0x18: "checksum delimiter",
    0x19: "acknowledge slot",
    0x1A: "end of frame",
    0x1B: "acknowledge delimiter",
}


def decode(frame: CanFrame) -> ErrorReport:
    """What the error frame `frame` says. Missing data bytes count as zero: an unspecified detail."""
    classes = ErrorClass(frame.can_id & 0x3FF)
    data = frame.data.ljust(8, b"\0")
    details = []
    if classes & ErrorClass.CONTROLLER:
        details.append(_named(CONTROLLER_TEXTS, data[1]) or "controller problem")
    if classes & ErrorClass.PROTOCOL:
        violation = _named(VIOLATION_TEXTS, data[2]) or "protocol violation"
        details.append(f"{violation} in {LOCATION_TEXTS[data[3]]}" if data[3] in LOCATION_TEXTS else violation)
    if classes & ErrorClass.LOST_ARBITRATION:
        details.append(f"arbitration lost in bit {data[0]}" if data[0] else "arbitration lost")
    details.extend(text for error_class, text in CLASS_TEXTS.items() if classes & error_class)

    counted = bool(classes & ErrorClass.COUNTERS)
    transmit_errors, receive_errors = (data[6], data[7]) if counted else (None, None)
    if counted:
        details.append(f"error counters: {data[6]} transmit, {data[7]} receive")
    text = "; ".join(details) or f"error class {frame.can_id:03X}h"
    return ErrorReport(classes, _state(classes, data[1]), text, transmit_errors, receive_errors)


def _named(names: dict[int, str], bits: int) -> str:
    return ", ".join(name for bit, name in names.items() if bits & bit)


def _state(classes: ErrorClass, controller: int) -> ControllerState:
    if classes & ErrorClass.BUS_OFF:
        return ControllerState.BUS_OFF
    if classes & ErrorClass.RESTARTED:
        return ControllerState.ERROR_ACTIVE
    if classes & ErrorClass.CONTROLLER:
        if controller & 0x30:
            return ControllerState.PASSIVE
        if controller & 0x0C:
            return ControllerState.WARNING
        if controller & 0x40:
            return ControllerState.ERROR_ACTIVE
    return ControllerState.UNKNOWN
