"""The balancing robot: mechanics, motors and battery, stepped together; the truth behind the bus."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import ClassVar

from upright.simulation.bus.drives.voltage_drive import VoltageDrive
from upright.simulation.bus.machine import Machine, Motion
from upright.simulation.config import DriveNode, SimulationConfig
from upright.simulation.physics.input_effects import input_effects
from upright.simulation.registry import check_onsets
from upright.simulation.twsbr.effects import gear_effects, tilt_effects, wheel_effects
from upright.simulation.twsbr.mechanics import PLACES, Drive, Held, Mechanics, State
from upright.simulation.twsbr.motor import Motor
from upright.simulation.twsbr.truth import TwsbrTruth
from upright.telemetry.samples import Vector3

RELEASE_DELAY = 0.1
"""s of power at both motors after which the stand releases the robot."""
TRAVEL, TURN, TILT, LEFT, RIGHT = range(PLACES)
"""Places of the coordinates in a state; their rates are `PLACES` places later."""


class TwsbrPlant(Machine):
    """Starts at rest as its `TwsbrTruth` says, with open bridges. `motors` are the left and the right one.

    Raises:
        UnknownEffectError: a hidden effect that does not exist.
    """

    name = "a balancing robot"
    roles: ClassVar[Mapping[str, int]] = {"wheel": 2}
    falling_axis = 1

    def __init__(self, config: SimulationConfig) -> None:
        truth = config.plant
        if not isinstance(truth, TwsbrTruth):
            raise TypeError(f"the physics of a balancing robot are needed, not {type(truth).__name__}")
        super().__init__(config.step, truth.falling_inertia)
        sizes, onsets = config.sizes, config.onsets
        check_onsets(onsets, truth.registry)
        self.mechanics = Mechanics(truth, backlash=sizes.get("backlash", 0.0), slope=sizes.get("slope", 0.0))
        self.motors = tuple(Motor(truth, self.step_size, input_effects(sizes, self.step_size)) for _ in range(2))
        self._radius = truth.wheel_radius
        self._supply = truth.supply_voltage
        self._sag = sizes.get("test_battery_sag", 0.0)
        self._tilt_effects = tilt_effects(sizes, onsets)
        self._random_torques = config.random_torques
        self._wheel_effects = tuple(wheel_effects(sizes, onsets) for _ in range(2))
        self._gear_effects = tuple(gear_effects(sizes, onsets, self.step_size) for _ in range(2))
        self._drives: tuple[Drive, Drive] = ((0.0, 0.0), (0.0, 0.0))
        self._held: Held = (0.0, 0.0, 0.0)
        self._powered_steps = 0
        self.state: State = (0.0,) * (2 * PLACES)
        if truth.start == "held":
            self.hold()
        else:
            self.place(self.mechanics.floor.resting_roll(self.mechanics.gravity_stiffness))

    @property
    def tilt(self) -> float:
        """rad."""
        return self.state[TILT]

    @property
    def tilt_rate(self) -> float:
        """rad/s."""
        return self.state[PLACES + TILT]

    @property
    def yaw(self) -> float:
        """rad, to the left."""
        return self.mechanics.yaw_per_turn * self.state[TURN]

    @property
    def travelled(self) -> float:
        """m, forwards along its path."""
        return self._radius * self.state[TRAVEL]

    def application(self, node: DriveNode, number: int) -> VoltageDrive:
        return VoltageDrive(node, self.motors[number])

    def restart_disturbance(self) -> None:
        for torque in self._random_torques:
            torque.restart()

    def place(self, tilt: float) -> None:
        """Release the robot at this tilt, at rest; its wheels have rolled along without turning in their gears."""
        self.mechanics.held_upright = False
        self._put(tilt)

    def hold(self, tilt: float = 0.0) -> None:
        """Put the robot at this tilt into the stand, which releases it once the motors have power."""
        self.mechanics.held_upright = True
        self._powered_steps = 0
        self._put(tilt)

    def step(self) -> None:
        if self.mechanics.held_upright:
            self._mind_the_stand()
        left, right = self.motors
        supply = self._supply
        if self._sag:
            supply -= self._sag * (left.duty * left.current + right.duty * right.current)
        clock = self.event_clock
        self._drives = (self._geared(0, left.set_voltage(supply)), self._geared(1, right.set_voltage(supply)))
        tilt, time = self.tilt, self.time
        on_tilt = sum([effect(tilt, time, clock) for effect in self._tilt_effects])
        for random in self._random_torques:
            on_tilt += random.torque(clock)
        on_tilt += self.load.torque(tilt, self.state[PLACES + TILT])
        self._held = (
            sum([effect(left, clock) for effect in self._wheel_effects[0]]),
            sum([effect(right, clock) for effect in self._wheel_effects[1]]),
            on_tilt,
        )
        self.state = self.mechanics.integrate(self.state, self.step_size, *self._drives, self._held)
        self.steps += 1
        self._show_motors()

    def motion(self) -> Motion:
        """Tilt, its rate and acceleration; speed and acceleration along the path; yaw rate and acceleration."""
        rates = self.mechanics.rates(self.state, *self._drives, self._held)
        speed, turn_rate, tilt_rate = rates[TRAVEL], rates[TURN], rates[TILT]
        acceleration, turning, tipping = rates[PLACES + TRAVEL], rates[PLACES + TURN], rates[PLACES + TILT]
        per_turn = self.mechanics.yaw_per_turn
        along = (self._radius * speed, self._radius * acceleration)
        return (self.tilt, tilt_rate, tipping, *along, per_turn * turn_rate, per_turn * turning)

    def felt(self, motion: Motion, position: Vector3, gravity: float) -> tuple[Vector3, Vector3]:
        """Gravity and the axle's acceleration seen from the tilted body, and w' x p + w x (w x p) at the position p."""
        tilt, rate, tipping, speed, acceleration, yaw_rate, turning = motion
        sine, cosine = math.sin(tilt), math.cos(tilt)
        angular = (-yaw_rate * sine, rate, yaw_rate * cosine)
        change = (-turning * sine - yaw_rate * rate * cosine, tipping, turning * cosine - yaw_rate * rate * sine)
        swing, whirl = _cross(change, position), _cross(angular, _cross(angular, position))
        force = (
            acceleration * cosine - gravity * sine + swing[0] + whirl[0],
            speed * yaw_rate + swing[1] + whirl[1],
            acceleration * sine + gravity * cosine + swing[2] + whirl[2],
        )
        return force, angular

    def _geared(self, side: int, drive: Drive) -> Drive:
        """`drive` with the torques of its gear added."""
        effects = self._gear_effects[side]
        if not effects:
            return drive
        standstill, damping = drive
        motor, clock = self.motors[side], self.event_clock
        return standstill + sum([effect(motor, clock) for effect in effects]), damping

    def _put(self, tilt: float) -> None:
        left, right = self.state[LEFT], self.state[RIGHT]
        self.state = (0.5 * (left + right) + tilt, 0.5 * (right - left), tilt, left, right, *(0.0,) * PLACES)
        self._show_motors()

    def _show_motors(self) -> None:
        state = self.state
        travel, turn, forward, swing = state[TRAVEL], state[TURN], state[PLACES + TRAVEL], state[PLACES + TURN]
        left, right = self.motors
        left.follow(travel - turn, forward - swing, state[LEFT], state[PLACES + LEFT])
        right.follow(travel + turn, forward + swing, state[RIGHT], state[PLACES + RIGHT])

    def _mind_the_stand(self) -> None:
        powered = all(motor.powered for motor in self.motors)
        self._powered_steps = self._powered_steps + 1 if powered else 0
        if self._powered_steps * self.step_size >= RELEASE_DELAY:
            self.mechanics.held_upright = False


def _cross(a: Vector3, b: Vector3) -> Vector3:
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])
