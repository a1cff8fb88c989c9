"""What every kind of vehicle can watch of the motion that it falls by, and how far it is known."""

from __future__ import annotations

from collections import deque

DEVIATIONS = 2.0
"""Standard deviations within which a parameter may be."""
SCALE = 0.1
"""Share by which a drive's rate or torque may differ from its setpoint for ever: an error of a gear ratio or unit,
which is an effect to be diagnosed. The controllers have a gain margin of several times that."""
JUMP_MEMORY = 0.05
"""s over which jumps of the gyro are added up."""
NOISE = 0.01
"""rad/s between two samples that are the gyro's own noise, or vibration."""


class GyroJumps:
    """Changes of the angular rate that are larger than anything can accelerate the vehicle. `jump` (rad/s) is their sum
    over `JUMP_MEMORY`. A wrong sample alone jumps there and back: the sum is not zero for one cycle, so that two cycles
    count."""

    __slots__ = ("_jumped", "_jumps", "_possible", "_rate", "jump")

    def __init__(self, acceleration: float, period: float) -> None:
        """`acceleration` (rad/s^2) is the largest that is possible, `period` (s) that of the samples."""
        self._possible = acceleration * period + NOISE
        self._jumps: deque[float] = deque(maxlen=max(2, round(JUMP_MEMORY / period)))
        self.reset()

    def reset(self) -> None:
        """Begin again: the next rate is the first."""
        self._jumps.clear()
        self._rate: float | None = None
        self._jumped = self.jump = 0.0

    def update(self, rate: float) -> float:
        """One cycle later (rad/s). Returns the change of the rate without what is a jump."""
        change = 0.0 if self._rate is None else rate - self._rate
        self._rate = rate
        beyond = max(change - self._possible, 0.0) + min(change + self._possible, 0.0)
        self._jumps.append(beyond)
        last, self._jumped = self._jumped, sum(self._jumps)
        self.jump = min(abs(last), abs(self._jumped))
        return change - beyond
