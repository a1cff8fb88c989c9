"""The robot's wheels: what their drives report, as one measurement a cycle.

Angles and rates are those of the wheels relative to the body, as their encoders count them, positive forward. With the
tilt they give the position of the wheels on the floor,  radius * (mean wheel angle + tilt).
"""

from __future__ import annotations

from dataclasses import dataclass

from upright.drivers.vehicle_io import VehicleIo

NAN = float("nan")


@dataclass(frozen=True, slots=True)
class WheelMeasurement:
    """What the drives reported last, rad and rad/s; `timestamp_ns` is that of the oldest value, 0 before they answered.

    `travel` is how far the wheels have rolled on the floor since the robot got up, m, and `heading` by how much they
    have turned it since then, rad, positive to the left.
    """

    timestamp_ns: int
    left_angle: float
    right_angle: float
    left_rate: float
    right_rate: float
    travel: float
    heading: float = 0.0

    @property
    def mean_angle(self) -> float:
        return 0.5 * (self.left_angle + self.right_angle)

    @property
    def mean_rate(self) -> float:
        return 0.5 * (self.left_rate + self.right_rate)


NOTHING_MEASURED = WheelMeasurement(0, NAN, NAN, NAN, NAN, NAN, NAN)


class Wheels:
    """The left and the right wheel, whose motors get the same voltage. `radius` and `distance` in m."""

    def __init__(self, io: VehicleIo, radius: float, distance: float) -> None:
        self._io = io
        self._left, self._right = io.role("wheel")
        self._radius = radius
        self._turn = radius / distance
        self._origin = self._apart = 0.0

    def measure(self) -> WheelMeasurement:
        """The drives' latest values; `NOTHING_MEASURED` until each of them has sent all of its own."""
        timestamp_ns = self._io.timestamp_ns
        if timestamp_ns == 0:
            return NOTHING_MEASURED
        left, right = self._left, self._right
        travel = self._radius * (0.5 * (left.position + right.position) - self._origin)
        heading = self._turn * (right.position - left.position - self._apart)
        return WheelMeasurement(
            timestamp_ns, left.position, right.position, left.velocity, right.velocity, travel, heading
        )

    def start_here(self) -> None:
        """Count travel and heading from where the wheels are now."""
        self._origin = 0.5 * (self._left.position + self._right.position)
        self._apart = self._right.position - self._left.position

    @property
    def left_voltage(self) -> float:
        """V as last sent, quantised."""
        return self._left.setpoint

    @property
    def right_voltage(self) -> float:
        """V as last sent, quantised."""
        return self._right.setpoint
