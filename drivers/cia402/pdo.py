"""Process data objects of a drive: objects by name, and struct codecs for the PDOs they are mapped into.

CiA 301: little-endian, objects one after the other without gaps, at most 8 bytes; a mapping entry in 1600h.. / 1A00h..
is index << 16 | subindex << 8 | length in bits. Object types are those of CiA 402.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence

from upright.drivers.cia402.modes import MODES
from upright.drivers.cia402.objects import CONTROLWORD, MODE_DISPLAY, STATUSWORD, ObjectEntry

MAX_PDOS = 4
"""PDOs of each direction that have a predefined COB-ID."""


def rpdo_objects(mode: int, fine_index: int) -> dict[str, ObjectEntry]:
    """The objects that can be sent to the drive in `mode`, one of `modes.MODES`, by name.

    `fine_index` is the vendor object of the fine part of the target, if the mode has one.
    """
    chosen = MODES[mode]
    fine = (ObjectEntry(chosen.fine, fine_index, 0, "h"),) if chosen.fine else ()
    return _by_name(CONTROLWORD, chosen.target, *fine)


def tpdo_objects() -> dict[str, ObjectEntry]:
    """The objects that the drive can send, by name."""
    return _by_name(
        STATUSWORD,
        ObjectEntry("velocity_actual_rpm", 0x6044, 0, "h"),
        MODE_DISPLAY,
        ObjectEntry("position_actual", 0x6064, 0, "i"),
        ObjectEntry("velocity_actual", 0x606C, 0, "i"),
        ObjectEntry("torque_actual", 0x6077, 0, "h"),
    )


def _by_name(*entries: ObjectEntry) -> dict[str, ObjectEntry]:
    return {entry.name: entry for entry in entries}


class PdoCodec:
    """Packs and unpacks one PDO: `size` bytes, `names` in order, `mapping` as it must stand in the drive."""

    __slots__ = ("mapping", "names", "pack", "size", "unpack")

    def __init__(self, mapped: Sequence[ObjectEntry]) -> None:
        layout = struct.Struct("<" + "".join(entry.code for entry in mapped))
        self.pack = layout.pack
        self.unpack = layout.unpack
        self.size = layout.size
        self.names = tuple(entry.name for entry in mapped)
        self.mapping = tuple(entry.mapping for entry in mapped)


def describe(mapping: Sequence[int]) -> str:
    """Mapping entries in words: `6040h:0 (16 bit), 6042h:0 (16 bit)`."""
    if not mapping:
        return "nothing"
    return ", ".join(f"{entry >> 16:04X}h:{entry >> 8 & 0xFF} ({entry & 0xFF} bit)" for entry in mapping)


def rpdo_cob_id(number: int, node: int) -> int:
    """Predefined COB-ID of receive PDO `number` (1 to 4)."""
    return 0x100 + 0x100 * number + node


def tpdo_cob_id(number: int, node: int) -> int:
    """Predefined COB-ID of transmit PDO `number` (1 to 4)."""
    return 0x080 + 0x100 * number + node
