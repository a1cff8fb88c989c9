"""One control moment gyroscope: a flywheel in a gimbal that a motor turns about the vehicle's vertical axis.

Turning the gimbal at a rate w gives the vehicle the roll torque  momentum * w * cos(angle); rolling the vehicle at a
rate p gives the gimbal the reaction  -momentum * p * cos(angle). The two exchange no energy with anything else. The
cosine applies with the hidden effect `gimbal_angle_coupling` only. With `backlash` the gimbal is a second inertia that
the motor drives through the backlash. rad, rad/s, N m.
"""

from __future__ import annotations

import math

from upright.simulation.physics.servo_axis import AxisMode, ServoAxis

BACKLASH_STIFFNESS = 2.0e5
"""N m/rad of the chain drive, beyond its backlash."""
BACKLASH_DAMPING = 400.0
"""N m s/rad, in contact."""
LOAD_SHARE = 0.4
"""Share of the inertia that is behind the backlash; the rest is the reflected rotor."""


class Gimbal:
    """`angle` and `rate` are the gimbal's; the drive's encoder sits on the motor side, `axis`."""

    def __init__(
        self,
        axis: ServoAxis,
        *,
        momentum: float,
        drag: float,
        brake_torque: float,
        step: float,
        coupling: float = 0.0,
        backlash: float = 0.0,
    ) -> None:
        self.axis = axis
        self.angle = 0.0
        self.rate = 0.0
        self.momentum = momentum
        """N m s, of the flywheel."""
        self._drag = drag
        self._brake_torque = brake_torque
        self._step = step
        self._coupling = coupling
        self._backlash = backlash

    def advance(self, roll_rate: float) -> float:
        """Move on by one step while the vehicle rolls at `roll_rate`; returns the resulting roll torque, N m."""
        momentum = self.momentum
        if self._coupling:
            momentum *= 1.0 + self._coupling * (math.cos(self.angle) - 1.0)
        if self._backlash:
            self._advance_with_backlash(-momentum * roll_rate)
        else:
            self._move(self.axis.inertia, -momentum * roll_rate)
            self.angle = self.axis.position
            self.rate = self.axis.rate
        self.axis.measure()
        return momentum * self.rate

    def _move(self, inertia: float, load: float) -> None:
        axis = self.axis
        rate = axis.rate
        torque = axis.drive() + load - self._drag * rate
        if axis.mode is AxisMode.BRAKED:
            torque += min(self._brake_torque, max(-self._brake_torque, -inertia * rate / self._step - torque))
        axis.rate = rate + self._step * torque / inertia
        axis.position += 0.5 * self._step * (rate + axis.rate)

    def _advance_with_backlash(self, load: float) -> None:
        axis = self.axis
        twist = axis.position - self.angle
        beyond = twist - min(0.5 * self._backlash, max(-0.5 * self._backlash, twist))
        contact = BACKLASH_STIFFNESS * beyond + BACKLASH_DAMPING * (axis.rate - self.rate) if beyond else 0.0
        self._move((1.0 - LOAD_SHARE) * axis.inertia, -contact)
        rate = self.rate
        self.rate = rate + self._step * (contact + load) / (LOAD_SHARE * axis.inertia)
        self.angle += 0.5 * self._step * (rate + self.rate)
