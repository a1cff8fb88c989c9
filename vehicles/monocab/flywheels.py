"""The angular momentum of the flywheels, from the speeds that their own inverters report.

    angular_momentum = sum of inertia * speed,    speed positive as each flywheel has to turn

so that a flywheel that turns the wrong way takes away what the other one gives. Without `[[flywheel]]` sections, and
while a speed is not known, it is the vehicle file's.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import tau

from upright.drivers.vehicle_io import VehicleIo
from upright.vehicles.monocab.file import MonocabFile

TURN = tau / 60.0
"""rad/s of a revolution per minute."""
SILENT = 1.0
"""s without a report after which the speed of a flywheel counts as not known. A flywheel loses some permille within
it, and inverters that report more seldom are of no use here."""
SLOW = 0.1
"""Share of the angular momentum that may be missing while the vehicle is up: the scale that the monitors of axes and
torque balance forgive (`vehicles.watch.SCALE`). With that much missing, the vehicle is still lowered in order."""


@dataclass(frozen=True, slots=True)
class FlywheelMeasurement:
    """`angular_momentum` (N m s) and `missing`, its share that is missing (0 if it is not measured); `silent`: name of
    a flywheel whose speed is not known."""

    angular_momentum: float
    missing: float = 0.0
    silent: str = ""


class Flywheels:
    """The flywheels of a vehicle file, as they are now."""

    def __init__(self, vehicle: MonocabFile, io: VehicleIo) -> None:
        self._nominal = vehicle.parameters.angular_momentum.value
        self._inertias = [each.inertia.value for each in vehicle.flywheel]
        self._speed = vehicle.flywheel_speed if vehicle.flywheel else 0.0
        self._io = io
        self._unknown = FlywheelMeasurement(self._nominal)

    def measure(self, now_ns: int) -> FlywheelMeasurement:
        """What is known at `now_ns`, the time of the drives' values."""
        if not self._inertias:
            return self._unknown
        momentum, silent = 0.0, ""
        for inertia, speed in zip(self._inertias, self._io.speeds, strict=True):
            if (now_ns - speed.timestamp_ns) * 1e-9 > SILENT:
                silent = silent or speed.config.name
            momentum += inertia * speed.speed
        if silent:
            return FlywheelMeasurement(self._nominal, silent=silent)
        return FlywheelMeasurement(momentum, missing=1.0 - momentum / self._nominal)

    def obstacles(self, measured: FlywheelMeasurement) -> list[str]:
        """What of the flywheels prevents the vehicle from getting up, each as a sentence with the remedy."""
        if measured.silent:
            short = sum(each.wrong_lengths for each in self._io.speeds if each.config.name == measured.silent)
            frames = f" ({short} frames with its can_id were too short)" if short else ""
            return [
                f"{measured.silent} does not report its speed{frames}: switch its inverter on, and check can_id and"
                " start_byte of its [[flywheel]] section against the inverter's PDO mapping."
            ]
        if abs(measured.missing) <= SLOW:
            return []
        rpm = self._speed / TURN
        speeds = ", ".join(f"{each.config.name} {round(each.speed / TURN)}" for each in self._io.speeds)
        wrong = [each.config.name for each in self._io.speeds if each.speed < -SLOW * self._speed]
        if wrong:
            return [
                f"{wrong[0]} turns the wrong way ({speeds} of {rpm:.0f} rpm): correct its inverter, or `direction`."
            ]
        way = "fast" if measured.missing < 0.0 else "slowly"
        return [f"The flywheels turn too {way} ({speeds} of {rpm:.0f} rpm): bring them to their speed first."]
