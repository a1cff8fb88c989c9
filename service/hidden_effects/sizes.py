"""From the smallest size that a diagnosis can see to the level of the virtual vehicle's hidden effect, and the truth.

The plant's sizes are in the unit of the catalogue's first amplitude and mean the same, so that a level is a quotient.
Some shapes differ: bristles instead of tanh, sinh instead of a cube. Where they do, no interval can be held to cover
the plant's size.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

from models.model import Model
from service.hidden_effects.cases import Case
from simulation.monocab.hidden import HIDDEN, UNLISTED
from telemetry.errors import UprightError

SAME_EQUATION = {
    "static_torque": "torque",
    "viscous_friction": "coefficient",
    "quadratic_drag": "coefficient",
    "gimbal_angle_coupling": "coupling",
    "gimbal_imbalance": "torque",
    "torque_step": "torque",
    "actuator_lag": "lag",
    "input_delay": "delay",
    "input_gain": "gain",
    "input_asymmetry": "asymmetry",
}
"""Effect to its amplitude, where plant and catalogue have one and the same equation and parameter."""

PLANT_SHAPES = {
    "end_stop.gap": math.radians(0.5),
    "hysteresis.yield_travel": 2.0e-3,
    "stribeck_friction.sliding": 0.5,
    "stribeck_friction.stribeck_rate": 0.01,
    "periodic_disturbance.frequency": 1.3,
    "position_cogging.pitch": 5.0e-3,
    "torque_step.rise": 0.3,
    "torque_drift.time_constant": 45.0,
    "flexible_mode.frequency": 7.0,
    "flexible_mode.damping_ratio": 0.03,
}
"""Shape parameters as the plant has them; when the torque step begins depends on when the record does."""


class NotDetectableError(UprightError):
    """Under these conditions the effect cannot be seen at any size, so there is no multiple of it."""


def levels(case: Case, detectable: Mapping[str, float]) -> dict[str, float]:
    """Effect to level of a case; the sign of those that may have either follows from the seed.

    `detectable`: effect to the smallest size that can be seen. Raises NotDetectableError.
    """
    found = {}
    for name in case.effects:
        effect = (HIDDEN | UNLISTED)[name]
        least = detectable.get(name, math.nan)
        if not (math.isfinite(least) and least > 0.0):
            raise NotDetectableError(
                f"{name} cannot be seen with {case.excitation}, of whatever size.", remedy="Excite otherwise."
            )
        sign = -1.0 if effect.signed and case.seed(f"sign of {name}") % 2 else 1.0
        found[name] = sign * case.size * least / abs(effect.size)
    return found


def plant_sizes(given: Mapping[str, float]) -> dict[str, float]:
    """Effect to size in its own unit."""
    return {name: level * (HIDDEN | UNLISTED)[name].size for name, level in given.items()}


def right_model(model: Model, given: Mapping[str, float], event: float) -> Model:
    """`model` with the effects that the plant has, at its sizes and shapes; `event` s is when a torque step begins.

    An effect that the catalogue does not have comes from `unlisted`.
    """
    from service.hidden_effects.unlisted import UNLISTED_EFFECTS

    sizes = plant_sizes(given)
    for name in given:
        model = model.add(UNLISTED_EFFECTS.get(name, name))
    shapes = {**PLANT_SHAPES, "torque_step.start": max(event, 0.0)}
    values = {name: value for name, value in shapes.items() if name in model.values}
    for attached in model.effects:
        if attached.name in sizes:
            first = model.parameter(attached.amplitudes[0])
            values[first.name] = min(max(sizes[attached.name], first.lower), first.upper)
    return model.change(values)
