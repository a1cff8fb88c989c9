"""A drive without a holding brake, whose master sets torque or voltage: CiA 402 states, encoder, torque.

Without power the motor turns freely. Statusword bit 11 reports that the setpoint exceeds the drive's limits.
axis position = direction * axis_per_turn * increments / increments_per_turn; 6077h is per mille of the rated torque at
the motor. The setpoint, and how the motor is braked, are defined by `torque_drive` and `voltage_drive`.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from typing import ClassVar, Protocol

from upright.simulation.bus.drive_application import HALT, DriveApplication, permille, wrapped
from upright.simulation.bus.objects import (
    CONTROLWORD,
    MODE,
    MODE_DISPLAY,
    POSITION_ACTUAL,
    STATUSWORD,
    TORQUE_ACTUAL,
    VELOCITY_ACTUAL,
)
from upright.simulation.bus.power_state import PowerState
from upright.simulation.config import DriveNode

STANDSTILL_RATE = 0.5
"""rad/s of the axis below which it counts as at standstill (assumed)."""


class FreeMotor(Protocol):
    """A motor and its encoder, with the signs of the axis. Its setpoint is in V or N m at the axis."""

    powered: bool
    """False: no current flows."""
    target: float

    @property
    def demand(self) -> float:
        """The target within the drive's limits."""
        ...

    @property
    def limited(self) -> bool:
        """The target exceeds the drive's limits."""
        ...

    @property
    def torque(self) -> float:
        """N m at the axis."""
        ...

    @property
    def measured_position(self) -> float:
        """rad, in whole increments."""
        ...

    @property
    def measured_rate(self) -> float:
        """rad/s."""
        ...


class FreeDrive(DriveApplication):
    """A drive that passes a target on to `axis`, in the only mode of `modes`."""

    TARGET: ClassVar[int]
    """Key of the target's object."""
    DEMAND: ClassVar[int]
    """Key of the object for the target within the drive's limits."""
    MODE_BIT: ClassVar[int] = 0
    """Bit of the statusword that reports in this mode that the drive follows its target; 0 for none."""

    def __init__(self, config: DriveNode, axis: FreeMotor) -> None:
        self.axis = axis
        self._unit = self._unit_of(config)
        self._rate_unit = config.direction * config.axis_per_turn / 60.0 * config.velocity_unit_rpm
        self._increment = config.direction * config.axis_per_turn / config.increments_per_turn
        self._permille = config.direction * config.axis_per_turn / (2.0 * math.pi) * 1000.0 / config.rated_torque
        super().__init__(config, (self.TARGET,))

    @staticmethod
    @abstractmethod
    def _unit_of(config: DriveNode) -> float:
        """V, or N m at the axis, of one unit of target and demand, direction included."""

    def sample(self) -> None:
        image, axis = self.image, self.axis
        word = self._statusword()
        if self.power.state is PowerState.OPERATION_ENABLED:
            word |= (0x800 if axis.limited else 0) | (self.MODE_BIT if self._follows else 0)
        image[STATUSWORD] = word
        image[MODE_DISPLAY] = self.shown_mode
        image[self.DEMAND] = permille(axis.demand / self._unit)
        image[POSITION_ACTUAL] = wrapped(round(axis.measured_position / self._increment))
        image[VELOCITY_ACTUAL] = round(axis.measured_rate / self._rate_unit)
        image[TORQUE_ACTUAL] = permille(axis.torque * self._permille)

    @property
    def _follows(self) -> bool:
        return self.image[MODE] in self.modes and not self.image[CONTROLWORD] & HALT

    def _release(self) -> None:
        self._unpower(0.0)

    def _standstill(self) -> bool:
        return not self.axis.powered or abs(self.axis.measured_rate) < STANDSTILL_RATE

    def _brake(self) -> None:
        self.axis.powered = True
        self.axis.target = self._braking()

    @abstractmethod
    def _braking(self) -> float:
        """The target that brings the axis to a standstill."""

    def _drive(self) -> None:
        self.axis.powered = True
        self.axis.target = self.image[self.TARGET] * self._unit if self._follows else 0.0

    def _unpower(self, now: float) -> None:
        self.axis.powered = False
        self.axis.target = 0.0
