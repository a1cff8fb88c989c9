"""The application of a servo inverter: CiA 402 states, velocity modes 2 and 9, statusword and actual values.

Mode 2 (velocity): 6042h in rpm plus a fine part in 1/8192 rpm, with the drive's ramp and, where the drive honours
them, controlword bits 4 (enable ramp), 5 (unlock ramp) and 6 (use the reference). Mode 9 (cyclic synchronous
velocity): 60FFh in the drive's velocity unit, no ramp. A drive that loses power closes its holding brake: at once at
standstill, else after it has coasted for the brake's closing time.
axis rate = direction * axis_per_turn * rpm / 60; torques in N m at the motor.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from simulation.config import DriveNode
from simulation.objects import (
    CONTROLWORD,
    ERROR_CODE,
    ERROR_REGISTER,
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
from simulation.power_state import PowerState, PowerStateMachine
from simulation.servo_axis import AxisMode, ServoAxis

VELOCITY = 2
CYCLIC_SYNCHRONOUS_VELOCITY = 9
MODES = (VELOCITY, CYCLIC_SYNCHRONOUS_VELOCITY)
FINE_UNITS_PER_RPM = 8192
BRAKE_DELAY = 0.06
"""s that a holding brake takes to close."""
STANDSTILL_RPM = 5.0
TARGET_WINDOW_RPM = 10.0
HALT, REFERENCE_BITS, UNLOCK_RAMP = 0x100, 0x50, 0x20


@dataclass(slots=True)
class DriveParameters:
    """What a master can set by SDO: option codes and ramps (rpm/s), with the values of an unset drive."""

    quick_stop_option: int = 2
    shutdown_option: int = 0
    disable_option: int = 1
    fault_reaction: int = 2
    acceleration: float = 30_000.0
    deceleration: float = 30_000.0
    quick_stop: float = 30_000.0
    maximum_rpm: float = 3000.0


class ServoDrive:
    """`image` holds the process data, keyed as in `objects`; `write` takes a value from the bus."""

    def __init__(self, config: DriveNode, axis: ServoAxis) -> None:
        self.axis = axis
        self.parameters = DriveParameters()
        self.power = PowerStateMachine()
        self.remote = False
        """The NMT state lets the master control the drive (statusword bit 9)."""
        self.synchronous = False
        """SYNCs arrive (statusword bit 8 in mode 9)."""
        self._config = config
        self._fine = config.target_velocity_fine_index << 8
        self._rpm_to_axis = config.direction * config.axis_per_turn / 60.0
        self._increments_to_axis = config.direction * config.axis_per_turn / config.increments_per_turn
        self._torque_to_permille = config.direction * config.axis_per_turn / (2.0 * math.pi) * 1000.0
        self._torque_to_permille /= config.rated_torque
        self._brake_due: float | None = None
        self._limited = False
        self.image: dict[int, int] = {}
        self.reset()

    def reset(self) -> None:
        """Process data of a drive that has just been switched on."""
        self.parameters = DriveParameters()
        self.image.clear()
        self.image.update(dict.fromkeys((CONTROLWORD, STATUSWORD, VL_TARGET_VELOCITY, TARGET_VELOCITY, self._fine), 0))
        self.image.update(dict.fromkeys((MODE, ERROR_CODE, ERROR_REGISTER), 0))

    @property
    def state(self) -> PowerState:
        return self.power.state

    def restart(self, now: float) -> None:
        """Power-on: the axis is on its brake."""
        self.reset()
        self.power.restart(now)
        self._brake_due = None
        self.axis.unpower(AxisMode.BRAKED)

    def write(self, key: int, value: int, now: float) -> bool:
        """Take a value for the image; whether it has reset a fault."""
        self.image[key] = value
        if key != CONTROLWORD:
            return False
        reset = self.power.write(value, now)
        if reset:
            self.image[ERROR_CODE] = self.image[ERROR_REGISTER] = 0
        return reset

    def fail(self, code: int, register: int, now: float, *, under_power: bool) -> None:
        """Go to Fault with this error code and error register."""
        self.image[ERROR_CODE] = code
        self.image[ERROR_REGISTER] = register | 0x01
        self.power.fail(now, under_power=under_power and self.parameters.fault_reaction > 0)
        self.update(now)

    def update(self, now: float) -> None:
        """Let the state machine move on and the axis follow it."""
        power = self.power
        power.stay_in_stop = self.parameters.quick_stop_option >= 5
        power.ramp_before_disable = self.parameters.disable_option == 1
        power.ramp_before_shutdown = self.parameters.shutdown_option == 1
        axis = self.axis
        resting = STANDSTILL_RPM * abs(self._rpm_to_axis)
        standstill = axis.mode is not AxisMode.DRIVEN or (abs(axis.demand) + abs(axis.measured_rate) < resting)
        power.update(now, standstill=standstill)
        coasts = power.state is PowerState.QUICK_STOP_ACTIVE and self.parameters.quick_stop_option == 0
        if power.stopping and not coasts:
            axis.ramp = self.parameters.quick_stop * abs(self._rpm_to_axis)
            axis.setpoint = 0.0
        elif power.state is PowerState.OPERATION_ENABLED:
            self._brake_due = None
            if axis.mode is not AxisMode.DRIVEN:
                axis.power()
            self._follow_target()
        elif axis.mode is AxisMode.DRIVEN:
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
        image[STATUSWORD] = self._statusword(rpm)
        image[MODE_DISPLAY] = image[MODE]
        image[VELOCITY_ACTUAL] = round(rpm / self._config.velocity_unit_rpm)
        image[VL_ACTUAL_VELOCITY] = round(rpm)
        image[VL_DEMAND] = round(axis.demand / self._rpm_to_axis)
        image[POSITION_ACTUAL] = _wrapped(math.floor(axis.measured_position / self._increments_to_axis))
        image[TORQUE_ACTUAL] = max(-32768, min(32767, round(axis.torque * self._torque_to_permille)))

    def _statusword(self, rpm: float) -> int:
        state = self.power.state
        word = int(state)
        if state is not PowerState.NOT_READY_TO_SWITCH_ON:
            word |= 0x10
        if self.remote:
            word |= 0x200
        if state is PowerState.OPERATION_ENABLED:
            if self.synchronous and self.image[MODE] == CYCLIC_SYNCHRONOUS_VELOCITY:
                word |= 0x100
            if abs(self.axis.setpoint / self._rpm_to_axis - rpm) < TARGET_WINDOW_RPM:
                word |= 0x400
            if self._limited or self.axis.limited:
                word |= 0x800
        return word


def _wrapped(value: int) -> int:
    """As a 32-bit counter shows it."""
    return (value + 0x8000_0000) % 0x1_0000_0000 - 0x8000_0000
