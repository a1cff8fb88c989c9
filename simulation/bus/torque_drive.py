"""The application of a servo drive whose master sets the torque: CiA 402 states and cyclic synchronous torque (10).

6071h is the motor's torque in per mille of the rated torque, from the next SYNC on. There is no holding brake: without
power the motor turns freely. Statusword bit 11 says that more was asked for than the current limit gives, bit 12 that
the drive follows the target. axis position = direction * axis_per_turn * increments / increments_per_turn.
"""

from __future__ import annotations

import math
from typing import Protocol

from simulation.bus.drive_application import HALT, DriveApplication, permille, wrapped
from simulation.bus.objects import (
    CONTROLWORD,
    MODE,
    MODE_DISPLAY,
    POSITION_ACTUAL,
    STATUSWORD,
    TARGET_TORQUE,
    TORQUE_ACTUAL,
    TORQUE_DEMAND,
    VELOCITY_ACTUAL,
)
from simulation.bus.power_state import PowerState
from simulation.config import DriveNode

CYCLIC_SYNCHRONOUS_TORQUE = 10
STANDSTILL_RATE = 0.5
"""rad/s of the axis below which it counts as standing."""
BRAKING_RATE = 10.0
"""rad/s of the axis from which on it is braked with the rated torque."""


class TorqueMotor(Protocol):
    """A motor with its current loop and its encoder; positive where the axis is."""

    powered: bool
    """False: no current flows."""
    target: float
    """N m at the axis."""

    @property
    def demand(self) -> float:
        """N m at the axis: the target within the current limit."""
        ...

    @property
    def limited(self) -> bool:
        """The target is beyond the current limit."""
        ...

    @property
    def torque(self) -> float:
        """N m at the axis."""
        ...

    @property
    def measured_position(self) -> float:
        """rad."""
        ...

    @property
    def measured_rate(self) -> float:
        """rad/s."""
        ...


class TorqueDrive(DriveApplication):
    """A drive that puts a torque on `axis`."""

    modes = (CYCLIC_SYNCHRONOUS_TORQUE,)

    def __init__(self, config: DriveNode, axis: TorqueMotor) -> None:
        self.axis = axis
        gear = 2.0 * math.pi / config.axis_per_turn
        self._rated = config.rated_torque * gear
        self._permille = config.direction * 1000.0 / self._rated
        self._rate_unit = config.direction * config.axis_per_turn / 60.0 * config.velocity_unit_rpm
        self._increment = config.direction * config.axis_per_turn / config.increments_per_turn
        super().__init__(config, (TARGET_TORQUE,))

    def sample(self) -> None:
        image, axis = self.image, self.axis
        word = self._statusword()
        if self.power.state is PowerState.OPERATION_ENABLED:
            word |= (0x800 if axis.limited else 0) | (0x1000 if self._follows else 0)
        image[STATUSWORD] = word
        image[MODE_DISPLAY] = image[MODE]
        image[TORQUE_DEMAND] = permille(axis.demand * self._permille)
        image[POSITION_ACTUAL] = wrapped(round(axis.measured_position / self._increment))
        image[VELOCITY_ACTUAL] = round(axis.measured_rate / self._rate_unit)
        image[TORQUE_ACTUAL] = permille(axis.torque * self._permille)

    @property
    def _follows(self) -> bool:
        return self.image[MODE] == CYCLIC_SYNCHRONOUS_TORQUE and not self.image[CONTROLWORD] & HALT

    def _release(self) -> None:
        self._unpower(0.0)

    def _standstill(self) -> bool:
        return not self.axis.powered or abs(self.axis.measured_rate) < STANDSTILL_RATE

    def _brake(self) -> None:
        self.axis.powered = True
        self.axis.target = self._rated * min(1.0, max(-1.0, -self.axis.measured_rate / BRAKING_RATE))

    def _drive(self) -> None:
        self.axis.powered = True
        self.axis.target = self.image[TARGET_TORQUE] / self._permille if self._follows else 0.0

    def _unpower(self, now: float) -> None:
        self.axis.powered = False
        self.axis.target = 0.0
