"""Hidden effects that act as a torque on the cube: at its edge, or between its wheel and its body. rad, s, N m."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Protocol

from upright.simulation.config import EVENT_TIME
from upright.simulation.physics.friction import AsymmetricFriction, LuGreFriction, StribeckFriction

EDGE_DEFLECTION = 2.0e-4
"""rad of the body at which the bristles of the edge begin to slide: 2 hundredths of a mm at its seat."""
EDGE_DAMPING = 0.01
"""s, damping over stiffness of these bristles."""
STRIBECK_RATE = 0.05
"""rad/s of the body at which most of the breakaway torque is gone."""
WHEEL_DEFLECTION = 2.0e-3
"""rad of the wheel at which the bristles of its bearings begin to slide."""
WHEEL_DAMPING = 2.0e-4
"""s, damping over stiffness of these bristles."""
FAN, SLOSH = 2.0 * math.pi * 1.3, 2.0 * math.pi * 0.7
"""rad/s."""
POLES = 7
"""Pole pairs of the motor: the cogging repeats this often per turn."""


class Tilting(Protocol):
    """The quantities of the cube that an effect depends on."""

    @property
    def tilt(self) -> float: ...
    @property
    def tilt_rate(self) -> float: ...
    @property
    def wheel_angle(self) -> float: ...
    @property
    def wheel_rate(self) -> float: ...
    @property
    def time(self) -> float: ...
    @property
    def event_clock(self) -> float: ...
    @property
    def step_size(self) -> float: ...


Torque = Callable[[Tilting], float]
"""N m, for this step; called once per step."""


def _at_the_edge(friction: LuGreFriction) -> Torque:
    return lambda cube: friction.force(cube.tilt_rate, 0.0, cube.step_size)


def _in_the_bearings(size: float) -> Torque:
    friction = LuGreFriction(size, WHEEL_DEFLECTION, WHEEL_DAMPING)
    return lambda cube: friction.force(cube.wheel_rate, 0.0, cube.step_size)


_EDGE: dict[str, Callable[[float], Torque]] = {
    "static_torque": lambda size: lambda cube: size,
    "viscous_friction": lambda size: lambda cube: -size * cube.tilt_rate,
    "coulomb_friction": lambda size: _at_the_edge(LuGreFriction(size, EDGE_DEFLECTION, EDGE_DAMPING)),
    "stribeck_friction": lambda size: _at_the_edge(
        StribeckFriction(size, EDGE_DEFLECTION, STRIBECK_RATE, EDGE_DAMPING)
    ),
    "asymmetric_friction": lambda size: _at_the_edge(AsymmetricFriction(size, EDGE_DEFLECTION, EDGE_DAMPING)),
    "cubic_stiffness": lambda size: lambda cube: -size * cube.tilt**3,
    "periodic_disturbance": lambda size: lambda cube: size * math.sin(FAN * cube.time),
    "torque_drift": lambda size: lambda cube: size * -math.expm1(-max(0.0, cube.event_clock) / 45.0),
    "test_cubic_drag": lambda size: lambda cube: -size * cube.tilt_rate**3,
    "test_varying_stiffness": lambda size: lambda cube: size * cube.tilt * math.sin(SLOSH * cube.time),
}

_WHEEL: dict[str, Callable[[float], Torque]] = {
    "wheel_viscous_friction": lambda size: lambda cube: -size * cube.wheel_rate,
    "wheel_coulomb_friction": _in_the_bearings,
    "wheel_drag": lambda size: lambda cube: -size * cube.wheel_rate * abs(cube.wheel_rate),
    "wheel_cogging": lambda size: lambda cube: size * math.sin(POLES * cube.wheel_angle),
}


def edge_effects(sizes: Mapping[str, float], onsets: Mapping[str, float]) -> tuple[Torque, ...]:
    """The torques on the body among the hidden effects `sizes` (name to amplitude), late ones at their `onsets` (s)."""
    found = _made(_EDGE, sizes, onsets)
    if "torque_step" in sizes:
        size, event = sizes["torque_step"], onsets.get("torque_step", EVENT_TIME)
        found.append(lambda cube: size * min(1.0, max(0.0, (cube.event_clock - event) / 0.3)))
    return tuple(found)


def wheel_effects(sizes: Mapping[str, float], onsets: Mapping[str, float]) -> tuple[Torque, ...]:
    """The torques on the wheel, and their reactions on the body, likewise."""
    return tuple(_made(_WHEEL, sizes, onsets))


def _made(
    makers: Mapping[str, Callable[[float], Torque]], sizes: Mapping[str, float], onsets: Mapping[str, float]
) -> list[Torque]:
    return [
        _late(maker(sizes[name]), onsets[name]) if name in onsets else maker(sizes[name])
        for name, maker in makers.items()
        if name in sizes
    ]


def _late(effect: Torque, onset: float) -> Torque:
    return lambda cube: effect(cube) if cube.event_clock >= onset else 0.0
