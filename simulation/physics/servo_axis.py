"""A motor-driven axis and the speed loop inside its drive, designed by the symmetric optimum.

The plant of the loop is a small time constant tau (current loop, filters) and an inertia J:  G = 1 / (J s (1 + tau s)).
PI controller with Kp = J / (2 tau), Ti = 4 tau, reference through the prefilter 1 / (1 + 4 tau s); closed loop
1 / (1 + 4 tau s + 8 tau^2 s^2 + 8 tau^3 s^3), close to one lag of 4 tau. Torque limit with conditional integration,
speed from encoder increments. Units are the axis': rad and N m, or m and N with a mass for the inertia.
"""

from __future__ import annotations

import math
from enum import Enum

from upright.simulation.physics.input_effects import InputEffect


class AxisMode(Enum):
    """What holds the axis. A drive that loses power closes its holding brake, as usual on servo motors with one."""

    DRIVEN = "driven"
    COASTING = "coasting"
    BRAKED = "braked"


class ServoAxis:
    """One axis; its plant calls `drive()` for the motor torque and `measure()` after each step."""

    def __init__(
        self,
        *,
        inertia: float,
        time_constant: float,
        torque_limit: float,
        encoder_step: float,
        step: float,
        effects: tuple[InputEffect, ...] = (),
    ) -> None:
        self.inertia = inertia
        self.mode = AxisMode.BRAKED
        self.position = 0.0
        self.rate = 0.0
        self.setpoint = 0.0
        self.ramp = math.inf
        """Largest change of the speed demand, axis/s^2."""
        self.demand = 0.0
        """Speed demand after the ramp."""
        self.torque = 0.0
        """Of the motor, at the axis."""
        self.measured_rate = 0.0
        self.limited = False
        """The torque limit is active."""
        self._gain = inertia / (2.0 * time_constant)
        self._integral_gain = self._gain * step / (4.0 * time_constant)
        self._prefilter = -math.expm1(-step / (4.0 * time_constant))
        self._lag = -math.expm1(-step / time_constant)
        self.torque_limit = torque_limit
        """Of the motor, at the axis."""
        self._encoder_step = encoder_step
        self._step = step
        self.effects = effects
        """What lies between setpoint and speed loop, in the order in which it acts."""
        self._reference = 0.0
        self._integral = 0.0
        self._count = 0

    @property
    def measured_position(self) -> float:
        """As measured by the encoder."""
        return self._count * self._encoder_step

    def power(self) -> None:
        """Release the brake and close the speed loop, without a bump."""
        self.mode = AxisMode.DRIVEN
        self.setpoint = self.demand = self._reference = self.rate
        self._integral = self.torque = 0.0

    def unpower(self, mode: AxisMode) -> None:
        """Remove the torque; the axis coasts or its brake closes."""
        self.mode = mode
        self.setpoint = self.demand = self._reference = self.torque = self._integral = 0.0
        self.limited = False

    def drive(self) -> float:
        """The motor torque of this step."""
        if self.mode is not AxisMode.DRIVEN:
            return 0.0
        target = self.setpoint
        for effect in self.effects:
            target = effect(target)
        change = target - self.demand
        limit = self.ramp * self._step
        if change > limit:
            change = limit
        elif change < -limit:
            change = -limit
        self.demand += change
        self._reference += self._prefilter * (self.demand - self._reference)
        error = self._reference - self.measured_rate
        torque = self._gain * error + self._integral
        limit = self.torque_limit
        if -limit < torque < limit:
            self._integral += self._integral_gain * error
            self.limited = False
        else:
            torque = limit if torque > 0.0 else -limit
            self.limited = True
        self.torque += self._lag * (torque - self.torque)
        return self.torque

    def measure(self) -> None:
        """Read the encoder: position in whole increments, speed as their difference over the step."""
        count = math.floor(self.position / self._encoder_step)
        self.measured_rate = (count - self._count) * self._encoder_step / self._step
        self._count = count
