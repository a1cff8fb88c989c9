"""The MONOCAB's gimbals, trim mass and flywheels: what is reported of them, as one measurement a cycle.

Sign: a positive precession rate gives a positive roll torque; each drive's `direction` maps its motor onto that.
"""

from __future__ import annotations

from dataclasses import dataclass

from upright.drivers.vehicle_io import VehicleIo
from upright.vehicles.monocab.file import MonocabFile
from upright.vehicles.monocab.flywheels import NOTHING_KNOWN, FlywheelMeasurement, Flywheels

NAN = float("nan")


@dataclass(frozen=True, slots=True)
class GimbalMeasurement:
    """What the drives reported last, in axis units (rad, rad/s, m, m/s).

    `timestamp_ns` is that of the oldest value in it, 0 while a drive has not answered yet; `gimbal_mismatch` is the
    largest difference between two gimbals (rad).
    """

    timestamp_ns: int
    precession: float
    precession_rate: float
    gimbal_mismatch: float
    trim_position: float
    trim_rate: float
    flywheels: FlywheelMeasurement = NOTHING_KNOWN


NOTHING_MEASURED = GimbalMeasurement(0, NAN, NAN, NAN, NAN, NAN)


class Gimbals:
    """The gimbals, which precess together, the trim mass if there is one, and what the flywheels report."""

    def __init__(self, vehicle: MonocabFile, io: VehicleIo) -> None:
        self._io = io
        self.flywheels = Flywheels(vehicle, io)
        self._gimbals = io.role("gimbal")
        self._trim = next(iter(io.role("trim")), None)

    def measure(self) -> GimbalMeasurement:
        """The drives' latest values; `NOTHING_MEASURED` until each of them has sent all of its own."""
        timestamp_ns = self._io.timestamp_ns
        if timestamp_ns == 0:
            return NOTHING_MEASURED
        positions = [gimbal.position for gimbal in self._gimbals]
        rates = [gimbal.velocity for gimbal in self._gimbals]
        trim = self._trim
        return GimbalMeasurement(
            timestamp_ns,
            sum(positions) / len(positions),
            sum(rates) / len(rates),
            max(positions) - min(positions),
            trim.position if trim is not None else 0.0,
            trim.velocity if trim is not None else 0.0,
            self.flywheels.measure(timestamp_ns),
        )

    @property
    def precession_rate_setpoint(self) -> float:
        """rad/s as last sent, quantised; the mean over the gimbals."""
        return sum([gimbal.setpoint for gimbal in self._gimbals]) / len(self._gimbals)

    @property
    def trim_rate_setpoint(self) -> float:
        """m/s as last sent, quantised."""
        return self._trim.setpoint if self._trim is not None else 0.0
