"""The process data of a virtual drive: keys of the objects its firmware acts on, and PDOs packed with one struct each.

A key is index << 8 | subindex; types are those of CiA 301.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass

from canopen.objectdictionary import datatypes

CONTROLWORD = 0x6040_00
STATUSWORD = 0x6041_00
VL_TARGET_VELOCITY = 0x6042_00
VL_DEMAND = 0x6043_00
VL_ACTUAL_VELOCITY = 0x6044_00
MODE = 0x6060_00
MODE_DISPLAY = 0x6061_00
POSITION_ACTUAL = 0x6064_00
VELOCITY_ACTUAL = 0x606C_00
TARGET_TORQUE = 0x6071_00
TORQUE_DEMAND = 0x6074_00
TORQUE_ACTUAL = 0x6077_00
TARGET_VELOCITY = 0x60FF_00
ERROR_CODE = 0x603F_00
ERROR_REGISTER = 0x1001_00
TARGET_VOLTAGE = 0x2400_00
"""Of upright_motor.eds, mV."""
VOLTAGE_DEMAND = 0x2401_00

STRUCT_CODES = {
    datatypes.BOOLEAN: "?",
    datatypes.INTEGER8: "b",
    datatypes.INTEGER16: "h",
    datatypes.INTEGER32: "i",
    datatypes.UNSIGNED8: "B",
    datatypes.UNSIGNED16: "H",
    datatypes.UNSIGNED32: "I",
}
MAX_PDO_BYTES = 8
MAX_PDOS = 4


def keys_by_name(mode: int, fine_index: int) -> dict[str, int]:
    """Key of each object that a vehicle file can map, in this mode of operation."""
    return {
        "controlword": CONTROLWORD,
        "statusword": STATUSWORD,
        "target_velocity": VL_TARGET_VELOCITY if mode == 2 else TARGET_VELOCITY,
        "target_velocity_fine": fine_index << 8,
        "velocity_actual": VELOCITY_ACTUAL,
        "velocity_actual_rpm": VL_ACTUAL_VELOCITY,
        "target_torque": TARGET_TORQUE,
        "torque_demand": TORQUE_DEMAND,
        "torque_actual": TORQUE_ACTUAL,
        "position_actual": POSITION_ACTUAL,
        "mode_display": MODE_DISPLAY,
        "target_voltage": TARGET_VOLTAGE,
        "voltage_demand": VOLTAGE_DEMAND,
    }


@dataclass(slots=True)
class Pdo:
    """One PDO that is in use."""

    cob_id: int
    type: int
    """Transmission type; up to 240 it goes with the SYNC."""
    timer: float
    """s, event timer: deadline of an RPDO, period of an event-driven TPDO; 0: none."""
    keys: tuple[int, ...]
    codec: struct.Struct
    data: bytes | None = None
    """RPDO: data waiting for the next SYNC. TPDO: data sent last."""
    due: float | None = None
    """s: when the RPDO is late, or the TPDO is next sent; None: not watched."""
    syncs: int = 0
    """SYNCs since the last transmission."""

    @property
    def synchronous(self) -> bool:
        return self.type <= 240
