"""The configuration of one drive from the vehicle file, and the conversion of its units to SI.

velocity (axis) = direction * axis_per_turn * rpm / 60,  position (axis) = direction * axis_per_turn * increments /
increments_per_turn; torque is the motor's, in N m, positive when it accelerates the axis in its positive direction.
A voltage is direction * units, positive when it drives the axis in its positive direction.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from upright.drivers.cia402 import pdo
from upright.drivers.cia402.modes import MODES, Mode
from upright.drivers.cia402.objects import ObjectEntry
from upright.drivers.cia402.pdo import PdoCodec
from upright.telemetry.errors import UprightError

SHIPPED_EDS = Path(__file__).resolve().parent.parent / "eds"
"""Folder of the electronic data sheets that ship with upright."""


class DriveConfigError(UprightError):
    """An invalid drive configuration. `drive` is its name, `key` the key of its section in the vehicle file."""

    def __init__(self, drive: str, key: str, message: str, *, remedy: str = "") -> None:
        super().__init__(f"drive {drive!r}: {key}: {message}", remedy=remedy)
        self.drive = drive
        self.key = key


@dataclass(frozen=True, slots=True)
class DriveConfig:
    """One drive. Checked on construction.

    Raises:
        DriveConfigError: a value or a PDO is invalid.
    """

    name: str
    role: str
    node: int
    direction: int
    """+1 or -1: sign of the axis for a positive motor speed."""
    axis_per_turn: float
    """rad or m of the axis per motor turn."""
    mode: int
    """CiA 402 mode, one of `modes.MODES`: 2 or 9 (velocity), 10 (torque), -1 (voltage)."""
    increments_per_turn: int
    """Of 6064h, per motor turn."""
    velocity_unit_rpm: float
    """rpm per unit of 606Ch and 60FFh."""
    rated_torque: float
    """N m at the motor: the base of 6071h and 6077h (per mille)."""
    rpdo: tuple[tuple[str, ...], ...]
    tpdo: tuple[tuple[str, ...], ...]
    follows: int = 0
    """Number of the controller's setpoint that it follows, from 0 on."""
    eds: str = "upright_servo.eds"
    """A shipped EDS by its name, or a path; see `find_eds`."""
    vendor_id: int = 0
    """1018h:1; 0: not checked."""
    product_code: int = 0
    """1018h:2; 0: not checked."""
    setpoint_resolution: float = 0.0
    """Resolution in axis unit/s, N m or V, if it is coarser than that of the objects; 0: that of the objects."""
    stop_reaction: Literal["quick_stop", "disable_voltage", "fault"] = "quick_stop"
    """What the drive does when the master is gone (6007h)."""
    sdo_timeout: float = 1.0
    """s that the drive may need to answer an SDO request, as after boot-up or while it stores a mapping."""
    mode_timeout: float = 5.0
    """s that the drive may need to adopt a mode, or to switch off."""
    target_velocity_fine_index: int = 0x2F15
    """Vendor object of the fine part of the target velocity, 1/8192 rpm."""

    def __post_init__(self) -> None:
        if not 1 <= self.node <= 127:
            self._refuse("node", f"{self.node} is not a CANopen node id", "Use 1 to 127.")
        if self.direction not in (1, -1):
            self._refuse("direction", f"{self.direction} is not a sign", "Use 1 or -1.")
        if self.mode not in MODES:
            self._refuse("mode", f"this driver has no mode {self.mode}", f"Use {_either(MODES)}.")
        for key in ("sdo_timeout", "mode_timeout"):
            value = getattr(self, key)
            if not (math.isfinite(value) and value > 0):
                self._refuse(key, f"{value} is not a time in s", "Use a little more than the drive needs.")
        for key in ("axis_per_turn", "increments_per_turn", "velocity_unit_rpm", "rated_torque"):
            value = getattr(self, key)
            if not (math.isfinite(value) and value > 0):
                self._refuse(key, f"{value} is not a positive number", "Take it from the drive's data sheet.")
        if not (math.isfinite(self.setpoint_resolution) and self.setpoint_resolution >= 0.0):
            message = f"{self.setpoint_resolution} is not a resolution"
            self._refuse("setpoint_resolution", message, "Use 0 if the drive resolves every unit of its objects.")
        self._check_pdos("rpdo", self.rpdo, self._rpdo_objects, needed=("controlword", self.operation.target.name))
        self._check_pdos("tpdo", self.tpdo, pdo.tpdo_objects(), needed=("statusword", "position_actual"))
        velocities = [name for pdo_names in self.tpdo for name in pdo_names if name.startswith("velocity_actual")]
        if len(velocities) != 1:
            self._refuse("tpdo", f"one velocity is needed, not {len(velocities)}", "Map velocity_actual, once.")

    def _check_pdos(
        self, key: str, pdos: tuple[tuple[str, ...], ...], known: dict[str, ObjectEntry], needed: tuple[str, ...]
    ) -> None:
        if len(pdos) > pdo.MAX_PDOS:
            self._refuse(key, f"{len(pdos)} PDOs", f"At most {pdo.MAX_PDOS} have a predefined COB-ID.")
        names = [name for pdo_names in pdos for name in pdo_names]
        for name in names:
            if name not in known:
                self._refuse(key, f"{name!r} cannot be mapped here in mode {self.mode}", f"Use {', '.join(known)}.")
            if names.count(name) > 1:
                self._refuse(key, f"{name!r} is mapped twice", "Map it once.")
        for name in needed:
            if name not in names:
                self._refuse(key, f"{name!r} is not mapped", "Without it the drive cannot be run; map it.")
        for pdo_names in pdos:
            size = sum(known[name].size for name in pdo_names)
            if not 1 <= size <= 8:
                self._refuse(key, f"{list(pdo_names)} has {size} bytes", "A PDO holds 1 to 8; use a second one.")

    def _refuse(self, key: str, message: str, remedy: str) -> None:
        raise DriveConfigError(self.name, key, message, remedy=remedy)

    @property
    def _rpdo_objects(self) -> dict[str, ObjectEntry]:
        return pdo.rpdo_objects(self.mode, self.target_velocity_fine_index)

    @property
    def mapped_objects(self) -> tuple[ObjectEntry, ...]:
        """Every object that is mapped, either way."""
        known = {**self._rpdo_objects, **pdo.tpdo_objects()}
        return tuple(known[name] for names in (*self.rpdo, *self.tpdo) for name in names)

    @property
    def rpdo_codecs(self) -> dict[int, PdoCodec]:
        """COB-ID to codec of the PDOs that the drive receives, in the order of their numbers."""
        known = self._rpdo_objects
        return {
            pdo.rpdo_cob_id(number, self.node): PdoCodec([known[name] for name in names])
            for number, names in enumerate(self.rpdo, start=1)
        }

    @property
    def tpdo_codecs(self) -> dict[int, PdoCodec]:
        """COB-ID to codec of the PDOs that the drive sends, in the order of their numbers."""
        known = pdo.tpdo_objects()
        return {
            pdo.tpdo_cob_id(number, self.node): PdoCodec([known[name] for name in names])
            for number, names in enumerate(self.tpdo, start=1)
        }

    @property
    def velocity_unit(self) -> float:
        """axis unit/s (rad/s or m/s) of one unit of 606Ch, direction included."""
        return self.direction * self.axis_per_turn * self.velocity_unit_rpm / 60.0

    @property
    def torque_unit(self) -> float:
        """N m at the motor of one unit of 6071h and 6077h, direction included."""
        return self.direction * self.rated_torque / 1000.0

    @property
    def operation(self) -> Mode:
        """Everything that depends on the mode."""
        return MODES[self.mode]

    def resolved(self, setpoint: float) -> float:
        """`setpoint` (axis unit/s, N m or V) rounded to the drive's resolution."""
        step = self.setpoint_resolution
        return step * round(setpoint / step) if step > 0.0 and math.isfinite(setpoint) else setpoint

    @property
    def setpoint_unit(self) -> float:
        """axis unit/s, N m or V of the smallest step of the setpoint, direction included."""
        return self.operation.step(self)

    @property
    def has_fine_part(self) -> bool:
        """Whether the setpoint is sent in two parts."""
        return any(self.operation.fine in names for names in self.rpdo)


def find_eds(eds: str, *, drive: str, folder: Path | None = None) -> Path:
    """The file of an EDS: beside the vehicle file (in `folder`), as a path of its own, or shipped.

    Raises:
        DriveConfigError: there is no such file; the error names `drive`.
    """
    places = [Path(eds), SHIPPED_EDS / eds]
    if folder is not None:
        places.insert(0, folder / eds)
    for place in places:
        if place.is_file():
            return place
    shipped = ", ".join(sorted(path.name for path in SHIPPED_EDS.glob("*.eds")))
    raise DriveConfigError(drive, "eds", f"there is no file {eds!r}", remedy=f"Give a path, or one of: {shipped}.")


def _either(numbers: Iterable[int]) -> str:
    """`2, 9 or -1`."""
    *first, last = map(str, numbers)
    return f"{', '.join(first)} or {last}"
