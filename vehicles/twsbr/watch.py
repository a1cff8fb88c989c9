"""What the wheels of a robot say about its motion: the acceleration of its axle, which the accelerometer shows, too."""

from __future__ import annotations

from math import cos, sin

from telemetry.samples import Vector3
from vehicles.contract import FIXED, Lean
from vehicles.twsbr.axes import WheelMeasurement


class TwsbrWatch:
    """`acceleration` (m/s^2, in the body's frame) of the axle, whose speed on the floor is radius (wheel' + tilt')."""

    __slots__ = ("_radius", "_speed", "acceleration")

    def __init__(self, radius: float) -> None:
        """`radius` of the wheels in m."""
        self._radius = radius
        self.reset()

    def reset(self) -> None:
        """Begin again: the next speed is the first."""
        self._speed: float | None = None
        self.acceleration: Vector3 = FIXED

    def update(self, dt: float, lean: Lean, drives: WheelMeasurement) -> None:
        """One cycle, `dt` s after the last one, before its setpoints are sent."""
        if drives.timestamp_ns == 0:
            return
        speed = self._radius * (drives.mean_rate + lean.rate)
        before, self._speed = speed if self._speed is None else self._speed, speed
        along = (speed - before) / dt
        self.acceleration = (along * cos(lean.angle), 0.0, along * sin(lean.angle))
