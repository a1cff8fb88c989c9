"""The supports: beams on both sides that carry the vehicle at +-4 deg. They push but never pull.

torque = -max(0, stiffness * depth + damping * depth'), depth being the roll beyond the support; rad, N m.
"""

from __future__ import annotations

import math


class Supports:
    """One-sided spring-dampers at +angle and -angle."""

    def __init__(self, angle: float, stiffness: float, damping: float) -> None:
        self.angle = angle
        self._stiffness = stiffness
        self._damping = damping

    def torque(self, roll: float, roll_rate: float) -> float:
        """Torque on the vehicle; zero between the supports."""
        if roll > self.angle:
            return -max(0.0, self._stiffness * (roll - self.angle) + self._damping * roll_rate)
        if roll < -self.angle:
            return max(0.0, self._stiffness * (-roll - self.angle) - self._damping * roll_rate)
        return 0.0

    def resting_roll(self, gravity_stiffness: float) -> float:
        """Roll at which the vehicle lies at rest on the right-hand support: gravity and support in balance."""
        roll = self.angle
        for _ in range(20):
            roll = self.angle + gravity_stiffness * math.sin(roll) / self._stiffness
        return roll
