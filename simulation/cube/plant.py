"""The cube on its edge with its reaction wheel: the truth behind the bus.

    I tilt''                    = G sin(tilt) - friction tilt' - wheel torque + supports + hidden effects + disturbance
    I_w (tilt'' + wheel'')      = wheel torque,         wheel torque = motor - wheel friction wheel' + hidden effects

I = I_b + m_w l^2 and G = (m_b l_b + m_w l) g, in the symbols of table I of the paper; the wheel's rate is relative to
the body. Integrated by velocity Verlet. SI units; plain floats, no arrays.
Source: Gajamohan, Merz, Thommen, D'Andrea, The Cubli: a cube that can jump up and balance, IROS 2012, section III.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import ClassVar

from upright.simulation.bus.drives.torque_drive import TorqueDrive
from upright.simulation.bus.machine import Machine, Motion
from upright.simulation.config import DriveNode, SimulationConfig
from upright.simulation.cube.effects import edge_effects, wheel_effects
from upright.simulation.cube.truth import CubeTruth
from upright.simulation.cube.wheel import Wheel
from upright.simulation.physics.contact import Supports
from upright.simulation.physics.input_effects import input_effects
from upright.simulation.registry import check_onsets
from upright.telemetry.samples import Vector3


class CubePlant(Machine):
    """Starts at rest on its front support, its wheel free.

    Raises UnknownEffectError for a hidden effect that does not exist.
    """

    name = "a cube"
    roles: ClassVar[Mapping[str, int]] = {"wheel": 1}
    falling_axis = 1

    def __init__(self, config: SimulationConfig) -> None:
        truth = config.plant
        if not isinstance(truth, CubeTruth):
            raise TypeError(f"the physics of a cube are needed, not {type(truth).__name__}")
        super().__init__(config.step, truth.falling_inertia)
        check_onsets(config.onsets, truth.registry)
        sizes = config.sizes
        self.wheel = Wheel(truth, self.step_size, input_effects(sizes, self.step_size), config.seed)
        self.supports = Supports(truth.support_angle, truth.support_stiffness, truth.support_damping)
        self.tilt = self.supports.resting_roll(truth.gravity_stiffness)
        self.tilt_rate = 0.0
        self.wheel_angle = 0.0
        self.wheel_rate = 0.0
        self._tilt_acceleration = 0.0
        self._wheel_acceleration = 0.0
        self._truth = truth
        self._inertia = truth.inertia
        self._gravity_stiffness = truth.gravity_stiffness
        self._edge_effects = edge_effects(sizes, config.onsets)
        self._wheel_effects = wheel_effects(sizes, config.onsets)
        self._random_torques = config.random_torques

    def application(self, node: DriveNode, number: int) -> TorqueDrive:
        return TorqueDrive(node, self.wheel)

    def restart_disturbance(self) -> None:
        self.wheel.restart()
        for torque in self._random_torques:
            torque.restart()

    def place(self, tilt: float) -> None:
        """Release the cube at this tilt, at rest."""
        self.tilt, self.tilt_rate = tilt, 0.0
        self.wheel_rate = 0.0
        self._balance()

    def step(self) -> None:
        step = self.step_size
        self.tilt_rate += 0.5 * step * self._tilt_acceleration
        self.wheel_rate += 0.5 * step * self._wheel_acceleration
        self.tilt += step * self.tilt_rate
        self.wheel_angle += step * self.wheel_rate
        self._balance()
        self.tilt_rate += 0.5 * step * self._tilt_acceleration
        self.wheel_rate += 0.5 * step * self._wheel_acceleration
        self.wheel.follow(self.wheel_angle)
        self.steps += 1

    def _balance(self) -> None:
        """The accelerations of body and wheel."""
        truth = self._truth
        on_wheel = self.wheel.drive() - truth.wheel_friction * self.wheel_rate
        for effect in self._wheel_effects:
            on_wheel += effect(self)
        on_body = (
            self._gravity_stiffness * math.sin(self.tilt)
            - truth.edge_friction * self.tilt_rate
            + self.supports.torque(self.tilt, self.tilt_rate)
            - on_wheel
        )
        for effect in self._edge_effects:
            on_body += effect(self)
        for random in self._random_torques:
            on_body += random.torque(self.event_clock)
        on_body += self.load.torque(self.tilt, self.tilt_rate)
        self._tilt_acceleration = on_body / self._inertia
        self._wheel_acceleration = on_wheel / truth.wheel_inertia - self._tilt_acceleration

    def motion(self) -> Motion:
        return (self.tilt, self.tilt_rate, self._tilt_acceleration)

    def felt(self, motion: Motion, position: Vector3, gravity: float) -> tuple[Vector3, Vector3]:
        """Along x: q'' z - q'^2 x - g sin(q), along z: g cos(q) - q'' x - q'^2 z; q is the tilt, (x, z) the place."""
        tilt, rate, acceleration = motion
        x, _, z = position
        force = (
            acceleration * z - rate * rate * x - gravity * math.sin(tilt),
            0.0,
            gravity * math.cos(tilt) - acceleration * x - rate * rate * z,
        )
        return force, (0.0, rate, 0.0)
