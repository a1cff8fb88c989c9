"""The cube's reaction wheel: what its drive reports, as one measurement a cycle."""

from __future__ import annotations

from dataclasses import dataclass

from upright.drivers.vehicle_io import VehicleIo

NAN = float("nan")


@dataclass(frozen=True, slots=True)
class WheelMeasurement:
    """What the drive reported last, rad and rad/s; `timestamp_ns` is that of the older value, 0 before it answered."""

    timestamp_ns: int
    angle: float
    rate: float


NOTHING_MEASURED = WheelMeasurement(0, NAN, NAN)


class Wheel:
    """The one drive of the cube."""

    def __init__(self, io: VehicleIo) -> None:
        self._io = io
        (self._drive,) = io.role("wheel")

    def measure(self) -> WheelMeasurement:
        """The drive's latest values; `NOTHING_MEASURED` until it has sent all of them."""
        timestamp_ns = self._io.timestamp_ns
        if timestamp_ns == 0:
            return NOTHING_MEASURED
        return WheelMeasurement(timestamp_ns, self._drive.position, self._drive.velocity)

    @property
    def torque(self) -> float:
        """N m as last sent, quantised."""
        return self._drive.setpoint
