"""The application of a servo inverter: CiA 402 states, velocity modes 2 and 9, statusword and actual values.

Mode 2 (velocity): 6042h in rpm plus a fine part in 1/8192 rpm, with the drive's ramp and, if the drive honours
them, controlword bits 4 (enable ramp), 5 (unlock ramp) and 6 (use the reference). Mode 9 (cyclic synchronous
velocity): 60FFh in the drive's velocity unit, no ramp. A drive that loses power closes its holding brake: at once at
standstill, else after it has coasted for the brake's closing time.
axis rate = direction * axis_per_turn * rpm / 60; torques in N m at the motor.
"""

from __future__ import annotations

import math

from upright.simulation.bus.drive_application import HALT, DriveApplication, permille, wrapped
from upright.simulation.bus.objects import (
    CONTROLWORD,
    MODE,
    MODE_DISPLAY,
    POSITION_ACTUAL,
    STATUSWORD,
    TARGET_VELOCITY,
    TORQUE_ACTUAL,
    VELOCITY_ACTUAL,
    VL_ACTUAL_VELOCITY,
    VL_DEMAND,
    VL_TARGET_VELOCITY,
)
from upright.simulation.bus.power_state import PowerState
from upright.simulation.config import DriveNode
from upright.simulation.physics.servo_axis import AxisMode, ServoAxis

VELOCITY = 2
CYCLIC_SYNCHRONOUS_VELOCITY = 9
MODES = (VELOCITY, CYCLIC_SYNCHRONOUS_VELOCITY)
FINE_UNITS_PER_RPM = 8192
BRAKE_DELAY = 0.06
"""s that a holding brake takes to close."""
STANDSTILL_RPM = 5.0
TARGET_WINDOW_RPM = 10.0
REFERENCE_BITS, UNLOCK_RAMP = 0x50, 0x20


class ServoDrive(DriveApplication):
    """A servo inverter that holds the speed of `axis`."""

    modes = MODES

    def __init__(self, config: DriveNode, axis: ServoAxis) -> None:
        self.axis = axis
        self._fine = config.target_velocity_fine_index << 8
        self._rpm_to_axis = config.direction * config.axis_per_turn / 60.0
        self._increments_to_axis = config.direction * config.axis_per_turn / config.increments_per_turn
        self._torque_to_permille = config.direction * config.axis_per_turn / (2.0 * math.pi) * 1000.0
        self._torque_to_permille /= config.rated_torque
        self._brake_due: float | None = None
        self._limited = False
        super().__init__(config, (VL_TARGET_VELOCITY, TARGET_VELOCITY, self._fine))

    def _release(self) -> None:
        self._brake_due = None
        self.axis.unpower(AxisMode.BRAKED)

    def _standstill(self) -> bool:
        axis = self.axis
        resting = STANDSTILL_RPM * abs(self._rpm_to_axis)
        return axis.mode is not AxisMode.DRIVEN or (abs(axis.demand) + abs(axis.measured_rate) < resting)

    def _brake(self) -> None:
        self.axis.ramp = self.parameters.quick_stop * abs(self._rpm_to_axis)
        self.axis.setpoint = 0.0

    def _drive(self) -> None:
        self._brake_due = None
        if self.axis.mode is not AxisMode.DRIVEN:
            self.axis.power()
        self._follow_target()

    def _unpower(self, now: float) -> None:
        axis = self.axis
        if axis.mode is AxisMode.DRIVEN:
            standstill = self._standstill()
            axis.unpower(AxisMode.BRAKED if standstill else AxisMode.COASTING)
            self._brake_due = None if standstill else now + BRAKE_DELAY
        elif self._brake_due is not None and now >= self._brake_due:
            axis.unpower(AxisMode.BRAKED)
            self._brake_due = None

    def _follow_target(self) -> None:
        image, axis, limit = self.image, self.axis, self.parameters.maximum_rpm
        controlword = image[CONTROLWORD]
        axis.ramp = math.inf
        if image[MODE] == VELOCITY:
            rpm = image[VL_TARGET_VELOCITY] + image[self._fine] / FINE_UNITS_PER_RPM
            faster = abs(rpm * self._rpm_to_axis) >= abs(axis.demand)
            ramp = self.parameters.acceleration if faster else self.parameters.deceleration
            axis.ramp = ramp * abs(self._rpm_to_axis)
            if self._config.ramp_bits and not controlword & UNLOCK_RAMP:
                return
            if self._config.ramp_bits and controlword & REFERENCE_BITS != REFERENCE_BITS:
                rpm = 0.0
        elif image[MODE] == CYCLIC_SYNCHRONOUS_VELOCITY:
            rpm = image[TARGET_VELOCITY] * self._config.velocity_unit_rpm
        else:
            rpm = 0.0
        if controlword & HALT:
            rpm = 0.0
        self._limited = abs(rpm) > limit
        axis.setpoint = min(limit, max(-limit, rpm)) * self._rpm_to_axis

    def sample(self) -> None:
        """Bring the actual values in the image up to date."""
        image, axis = self.image, self.axis
        rpm = axis.measured_rate / self._rpm_to_axis
        image[STATUSWORD] = self._statusword() | self._bits_of_mode(rpm)
        image[MODE_DISPLAY] = self.shown_mode
        image[VELOCITY_ACTUAL] = round(rpm / self._config.velocity_unit_rpm)
        image[VL_ACTUAL_VELOCITY] = round(rpm)
        image[VL_DEMAND] = round(axis.demand / self._rpm_to_axis)
        image[POSITION_ACTUAL] = wrapped(math.floor(axis.measured_position / self._increments_to_axis))
        image[TORQUE_ACTUAL] = permille(axis.torque * self._torque_to_permille)

    def _bits_of_mode(self, rpm: float) -> int:
        word = 0
        if self.power.state is PowerState.OPERATION_ENABLED:
            if self.synchronous and self.image[MODE] == CYCLIC_SYNCHRONOUS_VELOCITY:
                word |= 0x100
            if abs(self.axis.setpoint / self._rpm_to_axis - rpm) < TARGET_WINDOW_RPM:
                word |= 0x400
            if self._limited or self.axis.limited:
                word |= 0x800
        return word
