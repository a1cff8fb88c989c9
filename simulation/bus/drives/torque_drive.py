"""A servo drive whose master sets the torque: cyclic synchronous torque (mode 10).

6071h is the motor's torque in per mille of the rated torque, from the next SYNC on; 6074h is the part of it that the
current limit allows. Statusword bit 12 reports that the drive follows the target.
"""

from __future__ import annotations

import math

from upright.simulation.bus.drives.free_drive import FreeDrive
from upright.simulation.bus.objects import TARGET_TORQUE, TORQUE_DEMAND
from upright.simulation.config import DriveNode

CYCLIC_SYNCHRONOUS_TORQUE = 10
BRAKING_RATE = 10.0
"""rad/s of the axis above which it is braked with the rated torque; below it the torque is proportional to the rate, so
that the axis comes to rest (assumed)."""


class TorqueDrive(FreeDrive):
    """A drive that applies a torque to its axis."""

    modes = (CYCLIC_SYNCHRONOUS_TORQUE,)
    TARGET, DEMAND, MODE_BIT = TARGET_TORQUE, TORQUE_DEMAND, 0x1000

    @staticmethod
    def _unit_of(config: DriveNode) -> float:
        return config.direction * 2.0 * math.pi / config.axis_per_turn * config.rated_torque / 1000.0

    def _braking(self) -> float:
        rated = 1000.0 * abs(self._unit)
        return rated * min(1.0, max(-1.0, -self.axis.measured_rate / BRAKING_RATE))
