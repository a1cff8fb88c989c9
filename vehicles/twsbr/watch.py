"""What the wheels of a robot say about its motion: the acceleration of its axle, which the accelerometer shows, too."""

from __future__ import annotations

from math import cos, sin

from upright.estimators.checks.imu_consistency import AVERAGED
from upright.telemetry.samples import Vector3
from upright.vehicles.contract import Lean
from upright.vehicles.twsbr.axes import WheelMeasurement

AT_REST: Vector3 = (0.0, 0.0, 0.0)


class TwsbrWatch:
    """The axle's speed on the floor is radius (wheel' + tilt'). The rates of the wheels were measured at the SYNC
    before the IMU's sample, so that what they explain is the contradiction of the sample before."""

    averaged = AVERAGED[:1]
    """The filter takes an acceleration of the axle that lasts for a lean."""

    __slots__ = ("_acceleration", "_contradiction", "_radius", "_speed")

    def __init__(self, radius: float) -> None:
        """`radius` of the wheels in m."""
        self._radius = radius
        self.reset()

    def reset(self) -> None:
        """Begin again: the next speed is the first."""
        self._speed: float | None = None
        self._acceleration = self._contradiction = AT_REST

    def update(self, dt: float, lean: Lean, drives: WheelMeasurement) -> None:
        """One cycle, `dt` s after the last one, before its setpoints are sent."""
        if drives.timestamp_ns == 0:
            return
        speed = self._radius * (drives.mean_rate + lean.rate)
        before, self._speed = speed if self._speed is None else self._speed, speed
        along = (speed - before) / dt
        self._acceleration = (along * cos(lean.angle), 0.0, along * sin(lean.angle))

    def unexplained(self, contradiction: Vector3) -> Vector3:
        """What is left of the contradiction (m/s^2) of the sample before this one."""
        (x, y, z), self._contradiction = self._contradiction, contradiction
        ax, ay, az = self._acceleration
        return (x - ax, y - ay, z - az)
