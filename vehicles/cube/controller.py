"""The controller of the reaction-wheel cube: an LQI that holds it up and brings its wheel back to where it stood.

One step per control cycle (gains from `models.control_design.lqi`):

    torque = -(k_tilt tilt + k_rate tilt' + k_wheel wheel' + k_previous torque before + k_angle q) + excitation

q is the integral of the wheel's rate. Without it a static torque, or an IMU that is mounted at a slant, would spin the
wheel up or keep it turning; with it the cube settles at the lean at which it is in balance, and the wheel comes to
rest. (The paper estimates that angle by a filter instead: section V.) The integral is held while the torque is at its
limit (conditional integration; Astroem and Haegglund, Advanced PID Control, section 3.5).

Signs: see `channels`. rad, rad/s, N m.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from upright.models.control_design.lqi import LqiGains, LqiWeights, StateSpace
from upright.models.control_design.robustness import CheckedDesign, Known, Spread, checked_design
from upright.vehicles.cube.file import CubeFile

UNCERTAIN = ("inertia", "gravity_stiffness", "wheel_inertia")
"""Parameters whose error of a fifth the design must tolerate."""


def linear_model(values: Mapping[str, float]) -> StateSpace:
    """The cube about upright, by the parameters of a vehicle file: equations (1) and (2) of the paper, linear."""
    inertia, gravity, wheel = values["inertia"], values["gravity_stiffness"], values["wheel_inertia"]
    edge, bearing = values["edge_friction"], values["wheel_friction"]
    apart = 1.0 / wheel + 1.0 / inertia
    return StateSpace(
        A=np.array(
            [
                [0.0, 1.0, 0.0],
                [gravity / inertia, -edge / inertia, bearing / inertia],
                [-gravity / inertia, edge / inertia, -bearing * apart],
            ]
        ),
        B=np.array([[0.0], [-1.0 / inertia], [apart]]),
        C=np.array([[0.0, 0.0, 1.0]]),
        states=("tilt", "tilt_rate", "wheel_rate"),
        inputs=("torque",),
        outputs=("wheel_rate",),
    )


def design(vehicle: CubeFile, *, known: Known | None = None) -> CheckedDesign:
    """The controller of a vehicle file, designed from its parameters and checked a fifth around them, or wherever they
    may be if they are `known` from estimates. Raises ControlDesignError."""
    section, values = vehicle.controller, vehicle.parameters.values
    states = (section.tilt_weight, section.tilt_rate_weight, section.wheel_rate_weight)

    def at(factors: Mapping[str, float]) -> StateSpace:
        return linear_model({**values, **{name: factor * values[name] for name, factor in factors.items()}})

    weights = LqiWeights(states, (section.integral_weight,), (section.effort_weight,))
    uncertain = known.about(UNCERTAIN) if known else Spread(UNCERTAIN)
    return checked_design(at, uncertain, weights, vehicle.period)


class WheelController:
    """Holds the cube up: tilt, its rate and the wheel's rate in, the wheel's torque out.

    `torque` is the output of the last step; `limited` whether the limit reduced it.
    """

    __slots__ = ("_angle", "_angle_gain", "_gains", "_limit", "_previous_gain", "limited", "torque")

    def __init__(self, gains: LqiGains, limit: float) -> None:
        """`limit` of the torque in N m."""
        (self._gains,) = gains.states
        ((self._previous_gain,),) = gains.previous
        ((self._angle_gain,),) = gains.integral
        self._limit = limit
        self._angle = 0.0
        self.torque = 0.0
        self.limited = False

    def step(self, tilt: float, tilt_rate: float, wheel_rate: float, dt: float, excitation: float = 0.0) -> float:
        """One cycle: the torque, N m. `excitation` (N m) is added before the limit; `dt` s since the last cycle."""
        of_tilt, of_rate, of_wheel = self._gains
        angle = self._angle + wheel_rate * dt
        held = of_tilt * tilt + of_rate * tilt_rate + of_wheel * wheel_rate + self._previous_gain * self.torque
        wanted = excitation - (held + self._angle_gain * angle)
        limit = self._limit
        torque = limit if wanted > limit else -limit if wanted < -limit else wanted
        self.limited = torque != wanted
        if not self.limited:
            self._angle = angle
        self.torque = torque
        return torque
