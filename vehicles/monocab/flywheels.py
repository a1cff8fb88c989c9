"""The angular momentum of the flywheels, from the speeds that their own inverters report.

    angular_momentum = sum of inertia * speed,    speed positive as each flywheel has to turn

so that a flywheel that turns the wrong way takes away what the other one gives. It is not known (NaN) without
`[[flywheel]]` sections, and while one of them does not report.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import isnan, nan, tau

from upright.drivers.vehicle_io import VehicleIo
from upright.vehicles.monocab.file import MonocabFile

TURN = tau / 60.0
"""rad/s of a revolution per minute."""
SILENT = 1.0
"""s without a report after which the speed of a flywheel counts as not known. A flywheel without its motor loses less
than a hundredth of its speed within it."""
SLOW = 0.1
"""Share of the angular momentum that may be missing while the vehicle is up: the scale that the monitors of axes and
torque balance forgive (`vehicles.watch.SCALE`). With that much missing, the vehicle is still lowered in order."""


@dataclass(frozen=True, slots=True)
class FlywheelMeasurement:
    """`angular_momentum` (N m s) and `missing`, the share of the vehicle file's that is missing; `silence`: s since the
    oldest of the latest reports. Of a vehicle without `[[flywheel]]` nothing is known, missing or silent."""

    angular_momentum: float = nan
    missing: float = 0.0
    silence: float = 0.0


NOTHING_KNOWN = FlywheelMeasurement()


class Flywheels:
    """The flywheels of a vehicle file, as they are now."""

    def __init__(self, vehicle: MonocabFile, io: VehicleIo) -> None:
        self._nominal = vehicle.parameters.angular_momentum.value
        self._inertias = [each.inertia.value for each in vehicle.flywheel]
        self._speed = vehicle.flywheel_speed if vehicle.flywheel else nan
        self._speeds = io.speeds

    def measure(self, now_ns: int) -> FlywheelMeasurement:
        """What is known at `now_ns`, the time of the drives' values."""
        if not self._inertias:
            return NOTHING_KNOWN
        silence = (now_ns - min([each.timestamp_ns for each in self._speeds])) * 1e-9
        momentum = sum([inertia * each.speed for inertia, each in zip(self._inertias, self._speeds, strict=True)])
        if silence > SILENT or isnan(momentum):
            return FlywheelMeasurement(silence=silence)
        return FlywheelMeasurement(momentum, 1.0 - momentum / self._nominal, silence)

    def obstacles(self, measured: FlywheelMeasurement) -> list[str]:
        """What of the flywheels prevents the vehicle from getting up, each as a sentence with the remedy."""
        if measured.silence > SILENT:
            silent = min(self._speeds, key=lambda each: each.timestamp_ns)
            short = f" ({silent.wrong_lengths} frames with its can_id were too short)" if silent.wrong_lengths else ""
            return [
                f"{silent.config.name} does not report its speed{short}: switch its inverter on, and check can_id and"
                " start_byte of its [[flywheel]] section against the inverter's PDO mapping."
            ]
        if abs(measured.missing) <= SLOW:
            return []
        rpm = self._speed / TURN
        speeds = ", ".join(f"{each.config.name} {round(each.speed / TURN)}" for each in self._speeds)
        wrong = [each.config.name for each in self._speeds if each.speed < -SLOW * self._speed]
        if wrong:
            return [
                f"{wrong[0]} turns the wrong way ({speeds} of {rpm:.0f} rpm): correct its inverter, or `direction`."
            ]
        way = "fast" if measured.missing < 0.0 else "slowly"
        return [f"The flywheels turn too {way} ({speeds} of {rpm:.0f} rpm): bring them to their speed first."]
