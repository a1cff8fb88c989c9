"""The MONOCAB's roll motion with its gimbals and trim mass: the truth behind the bus.

    (inertia + m y^2) roll'' + m h y'' + 2 m y y' roll' = gravity_stiffness sin(roll) + m g y cos(roll) + gyroscopic
                                                          + supports + rail friction + hidden effects + disturbance
    (m + drive mass) y'' + m h roll''                   = force + m g sin(roll) + m y roll'^2 - drag y'

m is the trim mass at the height h, y its position to the right (Lagrange; `inertia` and `gravity_stiffness` contain the
mass in the middle). Roll and trim mass are integrated by velocity Verlet, the gimbals half a step apart from them
(leapfrog), so that the gyroscopic coupling neither feeds nor drains energy. SI units; plain floats, no arrays.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import ClassVar

from upright.simulation.bus.drives.servo_drive import ServoDrive
from upright.simulation.bus.machine import Machine, Motion
from upright.simulation.config import DriveNode, SimulationConfig
from upright.simulation.monocab.flywheel import Flywheel
from upright.simulation.monocab.gimbal import Gimbal
from upright.simulation.monocab.roll_effects import roll_effects
from upright.simulation.monocab.truth import PlantTruth
from upright.simulation.physics.contact import Supports
from upright.simulation.physics.input_effects import input_effects
from upright.simulation.physics.load import Action, Spin
from upright.simulation.physics.servo_axis import AxisMode, ServoAxis
from upright.simulation.registry import check_onsets
from upright.telemetry.samples import Vector3

DEFAULT_GIMBAL_PER_TURN = 2.0 * math.pi / 100.0
DEFAULT_TRIM_PER_TURN = 0.01


class Plant(Machine):
    """The vehicle's mechanics. Starts at rest on the right-hand support with its brakes closed."""

    name = "a MONOCAB"
    roles: ClassVar[Mapping[str, int]] = {"gimbal": 2, "trim": 1}
    falling_axis = 0

    def __init__(self, config: SimulationConfig) -> None:
        truth = config.plant
        if not isinstance(truth, PlantTruth):
            raise TypeError(f"the physics of a MONOCAB are needed, not {type(truth).__name__}")
        step = config.step
        sizes = config.sizes
        check_onsets(config.onsets, truth.registry)
        super().__init__(step, truth.falling_inertia)
        self.gimbals = tuple(
            Gimbal(
                ServoAxis(
                    inertia=0.5 * truth.gimbal_inertia,
                    time_constant=truth.gimbal_time_constant,
                    torque_limit=truth.gimbal_torque_limit,
                    encoder_step=per_turn / truth.encoder_increments_per_turn,
                    step=step,
                    effects=input_effects(sizes, step),
                ),
                momentum=0.5 * truth.angular_momentum,
                drag=truth.gimbal_drag,
                brake_torque=truth.gimbal_brake_torque,
                step=step,
                coupling=sizes.get("gimbal_angle_coupling", 0.0),
                backlash=sizes.get("backlash", 0.0),
            )
            for per_turn in (_per_turn(config.drives, "gimbal", i, DEFAULT_GIMBAL_PER_TURN) for i in range(2))
        )
        self.trim = ServoAxis(
            inertia=truth.trim_mass + truth.trim_drive_mass,
            time_constant=truth.trim_time_constant,
            torque_limit=truth.trim_force_limit,
            encoder_step=_per_turn(config.drives, "trim", 0, DEFAULT_TRIM_PER_TURN) / truth.encoder_increments_per_turn,
            step=step,
        )
        nominal = 0.5 * truth.angular_momentum / truth.flywheel_inertia
        running = not config.flywheels_stand
        self.flywheels = tuple(
            Flywheel(truth.flywheel_inertia, nominal, nominal if running else 0.0, on=running) for _ in self.gimbals
        )
        if not running:
            self._carry_momentum()
        self.supports = Supports(truth.support_angle, truth.support_stiffness, truth.support_damping)
        self.roll = self.supports.resting_roll(truth.gravity_stiffness)
        self.roll_rate = 0.0
        self.roll_acceleration = 0.0
        self.gyroscopic_torque = 0.0
        self._effects = roll_effects(sizes, inertia=truth.inertia, onsets=config.onsets)
        self._random_torques = config.random_torques
        self._inertia = truth.inertia * (1.0 - sizes.get("flexible_mode", 0.0))
        self._gravity_stiffness = truth.gravity_stiffness
        self._rail_friction = truth.rail_friction
        self._trim_mass = truth.trim_mass
        self._trim_coupling = truth.trim_mass * truth.trim_height
        self._trim_drag = truth.trim_drag
        self._gravity = truth.gravity
        self._trim_acceleration = 0.0

    @property
    def precession(self) -> float:
        """rad, mean of the gimbals."""
        return 0.5 * (self.gimbals[0].angle + self.gimbals[1].angle)

    @property
    def precession_rate(self) -> float:
        """rad/s, mean of the gimbals."""
        return 0.5 * (self.gimbals[0].rate + self.gimbals[1].rate)

    @property
    def speeds(self) -> tuple[float, ...]:
        return tuple(flywheel.speed for flywheel in self.flywheels)

    def undergo(self, action: Action | None) -> None:
        super().undergo(action)
        if isinstance(action, Spin):
            for flywheel in self.flywheels:
                flywheel.on = action.up

    def advance(self, steps: int) -> None:
        if not all(flywheel.steady for flywheel in self.flywheels):
            for flywheel in self.flywheels:
                flywheel.advance(steps * self.step_size)
            self._carry_momentum()
        super().advance(steps)

    def _carry_momentum(self) -> None:
        for gimbal, flywheel in zip(self.gimbals, self.flywheels, strict=True):
            gimbal.momentum = flywheel.inertia * flywheel.speed

    def application(self, node: DriveNode, number: int) -> ServoDrive:
        return ServoDrive(node, self.gimbals[number].axis if node.role == "gimbal" else self.trim)

    def motion(self) -> Motion:
        return (self.roll, self.roll_rate, self.roll_acceleration)

    def felt(self, motion: Motion, position: Vector3, gravity: float) -> tuple[Vector3, Vector3]:
        """Along y: g sin(q) - q'' z - q'^2 y, along z: g cos(q) + q'' y - q'^2 z; q is the roll, y and z the place."""
        roll, rate, acceleration = motion
        _, y, z = position
        force = (
            0.0,
            gravity * math.sin(roll) - acceleration * z - rate * rate * y,
            gravity * math.cos(roll) + acceleration * y - rate * rate * z,
        )
        return force, (rate, 0.0, 0.0)

    def restart_disturbance(self) -> None:
        for torque in self._random_torques:
            torque.restart()

    def place(self, roll: float) -> None:
        """Release the vehicle at this roll angle, at rest."""
        self.roll = roll
        self.roll_rate = 0.0
        self._balance()

    def step(self) -> None:
        step = self.step_size
        trim = self.trim
        self.roll_rate += 0.5 * step * self.roll_acceleration
        self.roll += step * self.roll_rate
        trim.rate += 0.5 * step * self._trim_acceleration
        trim.position += step * trim.rate
        self.gyroscopic_torque = sum([gimbal.advance(self.roll_rate) for gimbal in self.gimbals])
        self._balance()
        self.roll_rate += 0.5 * step * self.roll_acceleration
        trim.rate += 0.5 * step * self._trim_acceleration
        trim.measure()
        self.steps += 1

    def _balance(self) -> None:
        """Solve the two equations of motion for the accelerations of roll and trim mass."""
        roll, rate, trim, mass = self.roll, self.roll_rate, self.trim, self._trim_mass
        sine = math.sin(roll)
        torque = (
            self._gravity_stiffness * sine
            + mass * self._gravity * trim.position * math.cos(roll)
            + self.gyroscopic_torque
            + self.supports.torque(roll, rate)
            - (self._rail_friction + 2.0 * mass * trim.position * trim.rate) * rate
        )
        for effect in self._effects:
            torque += effect.torque(self)
        for random in self._random_torques:
            torque += random.torque(self.event_clock)
        torque += self.load.torque(roll, rate)
        inertia = self._inertia + mass * trim.position * trim.position
        if trim.mode is AxisMode.BRAKED:
            trim.rate = self._trim_acceleration = 0.0
            self.roll_acceleration = torque / inertia
            return
        force = trim.drive() + mass * (self._gravity * sine + trim.position * rate * rate) - self._trim_drag * trim.rate
        coupling = self._trim_coupling
        determinant = inertia * trim.inertia - coupling * coupling
        self.roll_acceleration = (torque * trim.inertia - coupling * force) / determinant
        self._trim_acceleration = (inertia * force - coupling * torque) / determinant


def _per_turn(drives: Sequence[DriveNode], role: str, number: int, default: float) -> float:
    nodes = [node for node in drives if node.role == role]
    return nodes[number].axis_per_turn if number < len(nodes) else default
