"""The modes of operation (6060h) in which a drive can be run, and everything that depends on the mode.

    2    velocity: 6042h in rpm, with the drive's ramp, and a fine part in 1/8192 rpm if that is mapped
    9    cyclic synchronous velocity: 60FFh in the drive's velocity unit
    10   cyclic synchronous torque: 6071h in per mille of the motor's rated torque
    -1   voltage, of upright_motor.eds: mean voltage at the motor; negative modes are manufacturer-specific (CiA 402)

A drive's setpoint is in axis unit/s (rad/s, m/s) in the velocity modes, in N m at the motor in the torque mode,
and in V in the voltage mode.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

from upright.drivers.cia402.objects import ObjectEntry
from upright.drivers.cia402.states import RAMP_BITS

FINE_UNITS_PER_RPM = 8192
"""Resolution of `target_velocity_fine`."""

VOLTAGE_UNIT = 1e-3
"""V per unit of `target_voltage`, 2400h of upright_motor.eds."""


class Scaling(Protocol):
    """What a mode needs to know of a drive; see `drivers.cia402.config.DriveConfig`."""

    @property
    def direction(self) -> int: ...
    @property
    def axis_per_turn(self) -> float: ...
    @property
    def velocity_unit(self) -> float: ...
    @property
    def torque_unit(self) -> float: ...
    @property
    def has_fine_part(self) -> bool: ...


@dataclass(frozen=True, slots=True)
class Mode:
    """One mode of operation.

    `target` is the object of the setpoint, `fine` the name of its vendor-specific fine part, "" if there is none;
    `step` gives the setpoint of its smallest unit, direction included; `enable_bits` are the bits of the controlword
    that the mode requires beyond enable operation; `cyclic`: the drive must know the time between two setpoints.
    """

    number: int
    target: ObjectEntry
    step: Callable[[Scaling], float]
    fine: str = ""
    enable_bits: int = 0
    cyclic: bool = False


def _rpm(drive: Scaling) -> float:
    return drive.direction * drive.axis_per_turn / (60.0 * (FINE_UNITS_PER_RPM if drive.has_fine_part else 1))


MODES = {
    mode.number: mode
    for mode in (
        Mode(
            2, ObjectEntry("target_velocity", 0x6042, 0, "h"), _rpm, fine="target_velocity_fine", enable_bits=RAMP_BITS
        ),
        Mode(9, ObjectEntry("target_velocity", 0x60FF, 0, "i"), lambda drive: drive.velocity_unit, cyclic=True),
        Mode(10, ObjectEntry("target_torque", 0x6071, 0, "h"), lambda drive: drive.torque_unit, cyclic=True),
        Mode(-1, ObjectEntry("target_voltage", 0x2400, 0, "h"), lambda drive: drive.direction * VOLTAGE_UNIT),
    )
}
"""By number."""


def supported(bits: int) -> tuple[int, ...]:
    """The modes of a drive by 6502h: bit n - 1 is mode n, and bit 15 + n the manufacturer-specific mode -n."""
    standard = tuple(bit + 1 for bit in range(16) if bits >> bit & 1)
    return standard + tuple(15 - bit for bit in range(16, 32) if bits >> bit & 1)
