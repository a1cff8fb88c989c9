"""Hidden effects that act as a torque on the balancing robot: on its tilt, on each of its wheels, or in each of its
gears, between motor and body. rad, s, N m."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping

from upright.simulation.config import EVENT_TIME
from upright.simulation.physics.friction import (
    AsymmetricFriction,
    LoadDependentFriction,
    LuGreFriction,
    StribeckFriction,
)
from upright.simulation.twsbr.motor import Motor

BRISTLE_DEFLECTION = 2.0e-4
"""rad of a wheel at which the bristles begin to slide: a hundredth of a mm at the motor's brushes, 1 mm from its axis
and on the fast side of the gear."""
BRISTLE_DAMPING = 2.0e-4
"""s, damping over stiffness of the bristles. A turning wheel bends them again at each reversal, and damping then adds
rate x damping / deflection of the friction: as much again at 1 rad/s."""
STRIBECK_RATE = 0.5
"""rad/s of a wheel relative to the body at which most of the breakaway torque is gone."""
TYPICAL_TORQUE = 0.2
"""N m of a motor, at the wheel."""

PULL = 0.05
"""rad (3 deg) of tilt above which a cable pulls no harder; otherwise the robot could not lie on its bumper."""

TiltEffect = Callable[[float, float, float], float]
"""Tilt, time and event clock to the torque on the tilt."""
WheelEffect = Callable[[Motor, float], float]
"""Motor with its wheel, and the event clock, to the torque on that wheel, or at the wheel in the gear; called once per
step."""

_TILT: dict[str, Callable[[float], TiltEffect]] = {
    "static_torque": lambda size: lambda tilt, time, clock: size,
    "cubic_stiffness": lambda size: lambda tilt, time, clock: -size * min(PULL, max(-PULL, tilt)) ** 3,
    "periodic_disturbance": lambda size: lambda tilt, time, clock: size * math.sin(2.0 * math.pi * 1.3 * time),
    "torque_drift": lambda size: lambda tilt, time, clock: size * -math.expm1(-max(0.0, clock) / 45.0),
    "test_varying_stiffness": lambda size: lambda tilt, time, clock: size * tilt * math.sin(2.0 * math.pi * 0.7 * time),
}

_BRISTLES: dict[str, Callable[[float], LuGreFriction]] = {
    "coulomb_friction": lambda size: LuGreFriction(size, BRISTLE_DEFLECTION, BRISTLE_DAMPING),
    "stribeck_friction": lambda size: StribeckFriction(size, BRISTLE_DEFLECTION, STRIBECK_RATE, BRISTLE_DAMPING),
    "asymmetric_friction": lambda size: AsymmetricFriction(size, BRISTLE_DEFLECTION, BRISTLE_DAMPING),
    "load_dependent_friction": lambda size: LoadDependentFriction(
        size, BRISTLE_DEFLECTION, TYPICAL_TORQUE, BRISTLE_DAMPING
    ),
}

_WHEEL: dict[str, Callable[[float], WheelEffect]] = {
    "viscous_friction": lambda size: lambda wheel, clock: -size * wheel.wheel_rate,
    "quadratic_drag": lambda size: lambda wheel, clock: -size * wheel.wheel_rate * abs(wheel.wheel_rate),
    "position_cogging": lambda size: lambda wheel, clock: size * math.sin(2.0 * wheel.wheel_angle),
    "test_cubic_drag": lambda size: lambda wheel, clock: -size * wheel.wheel_rate**3,
}


def tilt_effects(sizes: Mapping[str, float], onsets: Mapping[str, float]) -> tuple[TiltEffect, ...]:
    """The torques on the tilt among the hidden effects `sizes` (name to amplitude), late ones at their `onsets` (s)."""
    effects = [
        _late_on_tilt(maker(sizes[name]), onsets[name]) if name in onsets else maker(sizes[name])
        for name, maker in _TILT.items()
        if name in sizes
    ]
    if "torque_step" in sizes:
        size, event = sizes["torque_step"], onsets.get("torque_step", EVENT_TIME)
        effects.append(lambda tilt, time, clock: size * min(1.0, max(0.0, (clock - event) / 0.3)))
    return tuple(effects)


def wheel_effects(sizes: Mapping[str, float], onsets: Mapping[str, float]) -> tuple[WheelEffect, ...]:
    """The torques on one wheel, likewise."""
    return _made(_WHEEL, sizes, onsets)


def gear_effects(sizes: Mapping[str, float], onsets: Mapping[str, float], step: float) -> tuple[WheelEffect, ...]:
    """The torques in one gear, likewise; each gear needs its own, since bristles have a memory."""
    return _made({name: _rubbing(maker, step) for name, maker in _BRISTLES.items()}, sizes, onsets)


def _made(
    makers: Mapping[str, Callable[[float], WheelEffect]], sizes: Mapping[str, float], onsets: Mapping[str, float]
) -> tuple[WheelEffect, ...]:
    return tuple(
        _late_on_wheel(maker(sizes[name]), onsets[name]) if name in onsets else maker(sizes[name])
        for name, maker in makers.items()
        if name in sizes
    )


def _rubbing(maker: Callable[[float], LuGreFriction], step: float) -> Callable[[float], WheelEffect]:
    def make(size: float) -> WheelEffect:
        friction = maker(size)
        return lambda wheel, clock: friction.force(wheel.rotor_rate, wheel.torque, step)

    return make


def _late_on_tilt(effect: TiltEffect, onset: float) -> TiltEffect:
    return lambda tilt, time, clock: effect(tilt, time, clock) if clock >= onset else 0.0


def _late_on_wheel(effect: WheelEffect, onset: float) -> WheelEffect:
    return lambda wheel, clock: effect(wheel, clock) if clock >= onset else 0.0
