"""Hidden effects that act as a torque on the roll axis. Each is neutral unless it is switched on; N m, rad, s.

An effect sees the plant in the middle of an integration step and returns the torque that it adds to the balance
inertia * roll'' = gravity_stiffness * sin(roll) + gyroscopic torque + ...
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Protocol

from upright.simulation.config import EVENT_TIME
from upright.simulation.monocab.gimbal import Gimbal
from upright.simulation.physics.friction import (
    AsymmetricFriction,
    BoucWenHysteresis,
    LoadDependentFriction,
    LuGreFriction,
    Rolling,
    StribeckFriction,
)


class RollingVehicle(Rolling, Protocol):
    """The quantities of the vehicle that an effect on the roll axis depends on: rad and s."""

    @property
    def roll(self) -> float: ...
    @property
    def roll_acceleration(self) -> float: ...
    @property
    def time(self) -> float: ...
    @property
    def event_clock(self) -> float: ...
    @property
    def gimbals(self) -> Sequence[Gimbal]: ...


class RollEffect(Protocol):
    """A torque on the roll axis."""

    def torque(self, plant: RollingVehicle) -> float:
        """N m, for this step; called once per step."""
        ...


class _Formula:
    """An effect without memory."""

    def __init__(self, formula: Callable[[RollingVehicle], float]) -> None:
        self._formula = formula

    def torque(self, plant: RollingVehicle) -> float:
        return self._formula(plant)


class FlexibleMode:
    """Part of the inertia hangs on a torsion spring and a damper: the cabin on the frame.

    twist is the cabin's roll beyond the frame's:  cabin (roll'' + twist'') = -stiffness twist - damping twist'.
    """

    FREQUENCY = 2.0 * math.pi * 7.0  # rad/s
    DAMPING_RATIO = 0.03

    def __init__(self, share: float, inertia: float) -> None:
        self.cabin = share * inertia
        self._stiffness = self.cabin * self.FREQUENCY**2
        self._damping = 2.0 * self.DAMPING_RATIO * self.cabin * self.FREQUENCY
        self._twist = 0.0
        self._twist_rate = 0.0

    def torque(self, plant: RollingVehicle) -> float:
        spring = self._stiffness * self._twist + self._damping * self._twist_rate
        self._twist_rate += plant.step_size * (-spring / self.cabin - plant.roll_acceleration)
        self._twist += plant.step_size * self._twist_rate
        return spring


def _static(size: float) -> RollEffect:
    return _Formula(lambda plant: size)


def _viscous(size: float) -> RollEffect:
    return _Formula(lambda plant: -size * plant.roll_rate)


def _quadratic(size: float) -> RollEffect:
    return _Formula(lambda plant: -math.copysign(size * plant.roll_rate**2, plant.roll_rate))


def _progressive(size: float) -> RollEffect:
    scale = 0.05  # rad, at which the progressive spring leaves the cubic

    def formula(plant: RollingVehicle) -> float:
        ratio = plant.roll / scale
        return -6.0 * size * scale**3 * (math.sinh(ratio) - ratio)

    return _Formula(formula)


def _buffer(size: float) -> RollEffect:
    touch = math.radians(0.5)
    return _Formula(lambda plant: -math.copysign(size * max(0.0, abs(plant.roll) - touch), plant.roll))


def _cogging(size: float) -> RollEffect:
    return _Formula(lambda plant: size * math.sin(2.0 * math.pi * plant.roll / 5.0e-3))


def _machinery(size: float) -> RollEffect:
    return _Formula(lambda plant: size * math.sin(2.0 * math.pi * 1.3 * plant.time))


def _drift(size: float) -> RollEffect:
    return _Formula(lambda plant: size * -math.expm1(-max(0.0, plant.event_clock) / 45.0))


def _imbalance(size: float) -> RollEffect:
    def formula(plant: RollingVehicle) -> float:
        return 0.5 * size * sum(math.sin(gimbal.angle) for gimbal in plant.gimbals)

    return _Formula(formula)


def _cubic_drag(size: float) -> RollEffect:
    return _Formula(lambda plant: -size * plant.roll_rate**3)


def _one_sided_damping(size: float) -> RollEffect:
    return _Formula(lambda plant: -size * plant.roll * plant.roll_rate)


def _varying_stiffness(size: float) -> RollEffect:
    return _Formula(lambda plant: size * plant.roll * math.sin(2.0 * math.pi * 0.7 * plant.time))


def _patchy_damping(size: float) -> RollEffect:
    return _Formula(lambda plant: -size * plant.roll_rate * math.sin(2.0 * math.pi * plant.roll / 0.01))


_MAKERS: dict[str, Callable[[float], RollEffect]] = {
    "static_torque": _static,
    "viscous_friction": _viscous,
    "coulomb_friction": LuGreFriction,
    "stribeck_friction": StribeckFriction,
    "asymmetric_friction": AsymmetricFriction,
    "load_dependent_friction": LoadDependentFriction,
    "quadratic_drag": _quadratic,
    "cubic_stiffness": _progressive,
    "end_stop": _buffer,
    "hysteresis": BoucWenHysteresis,
    "position_cogging": _cogging,
    "periodic_disturbance": _machinery,
    "torque_drift": _drift,
    "gimbal_imbalance": _imbalance,
    "test_cubic_drag": _cubic_drag,
    "test_one_sided_damping": _one_sided_damping,
    "test_varying_stiffness": _varying_stiffness,
    "test_patchy_damping": _patchy_damping,
}


class _Late:
    """An effect that sets in `onset` s after the first SYNC."""

    def __init__(self, effect: RollEffect, onset: float) -> None:
        self._effect, self._onset = effect, onset

    def torque(self, plant: RollingVehicle) -> float:
        return self._effect.torque(plant) if plant.event_clock >= self._onset else 0.0


def roll_effects(sizes: Mapping[str, float], *, inertia: float, onsets: Mapping[str, float]) -> tuple[RollEffect, ...]:
    """The roll torques among the hidden effects `sizes` (name to amplitude), late ones at their `onsets` (s)."""
    effects = {name: maker(sizes[name]) for name, maker in _MAKERS.items() if name in sizes}
    effects |= {name: _Late(effect, onsets[name]) for name, effect in effects.items() if name in onsets}
    if "torque_step" in sizes:
        step, event = sizes["torque_step"], onsets.get("torque_step", EVENT_TIME)
        effects["torque_step"] = _Formula(lambda plant: step * min(1.0, max(0.0, (plant.event_clock - event) / 0.3)))
    if "flexible_mode" in sizes:
        effects["flexible_mode"] = FlexibleMode(sizes["flexible_mode"], inertia)
    return tuple(effects.values())
