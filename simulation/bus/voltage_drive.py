"""The application of a DC motor controller: CiA 402 states and a manufacturer-specific mode that sets the voltage.

Mode -1 (voltage): 2400h is the mean voltage at the motor in mV, from the next SYNC on. There is no holding brake:
without power the bridge is open and the motor turns freely. A stop under power puts 0 V on the motor, which shorts it,
until it stands still. Statusword bit 11 says that more was asked for than the supply gives. axis position = direction *
axis_per_turn * increments / increments_per_turn; torques in N m at the motor.
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
    TARGET_VOLTAGE,
    TORQUE_ACTUAL,
    VELOCITY_ACTUAL,
    VOLTAGE_DEMAND,
)
from simulation.bus.power_state import PowerState
from simulation.config import DriveNode

VOLTAGE = -1
STANDSTILL_RATE = 0.5
"""rad/s of the axis below which it counts as standing."""


class BridgedMotor(Protocol):
    """A motor on a bridge, and its encoder; positive where the axis is."""

    powered: bool
    """False: the bridge is open."""
    target: float
    """V."""

    @property
    def demand(self) -> float:
        """V that the bridge makes of the target at the nominal supply."""
        ...

    @property
    def limited(self) -> bool:
        """The target is beyond the supply."""
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


class VoltageDrive(DriveApplication):
    """A motor controller that puts a voltage on `axis`."""

    modes = (VOLTAGE,)

    def __init__(self, config: DriveNode, axis: BridgedMotor) -> None:
        self.axis = axis
        self._volts = config.direction * 1e-3
        self._rate_unit = config.direction * config.axis_per_turn / 60.0 * config.velocity_unit_rpm
        self._increment = config.direction * config.axis_per_turn / config.increments_per_turn
        self._permille = config.direction * config.axis_per_turn / (2.0 * math.pi) * 1000.0 / config.rated_torque
        super().__init__(config, (TARGET_VOLTAGE,))

    def sample(self) -> None:
        image, axis = self.image, self.axis
        word = self._statusword()
        if self.power.state is PowerState.OPERATION_ENABLED and axis.limited:
            word |= 0x800
        image[STATUSWORD] = word
        image[MODE_DISPLAY] = image[MODE]
        image[VOLTAGE_DEMAND] = round(axis.demand / self._volts)
        image[POSITION_ACTUAL] = wrapped(round(axis.measured_position / self._increment))
        image[VELOCITY_ACTUAL] = round(axis.measured_rate / self._rate_unit)
        image[TORQUE_ACTUAL] = permille(axis.torque * self._permille)

    def _release(self) -> None:
        self._unpower(0.0)

    def _standstill(self) -> bool:
        return not self.axis.powered or abs(self.axis.measured_rate) < STANDSTILL_RATE

    def _brake(self) -> None:
        self.axis.powered = True
        self.axis.target = 0.0

    def _drive(self) -> None:
        runs = self.image[MODE] == VOLTAGE and not self.image[CONTROLWORD] & HALT
        self.axis.powered = True
        self.axis.target = self.image[TARGET_VOLTAGE] * self._volts if runs else 0.0

    def _unpower(self, now: float) -> None:
        self.axis.powered = False
        self.axis.target = 0.0
