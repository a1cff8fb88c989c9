"""Levels of the virtual vehicle's hidden effects, from the minimum detectable effects of a diagnosis; the right model.

The plant's sizes have the unit and the meaning of the catalogue's first amplitude, so that a level is a quotient. Some
formulas differ: bristles instead of tanh, sinh instead of a cube. For these, the coverage of the plant's size by an
interval cannot be checked.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

from upright.models.model import Model
from upright.service.hidden_effects.cases import Case
from upright.simulation.monocab.hidden import HIDDEN, UNLISTED
from upright.telemetry.errors import UprightError

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
"""Amplitudes of the effects that have the same equation and parameter in plant and catalogue."""

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
"""Shape parameters of the plant. The start of the torque step depends on the start of the record."""


class NotDetectableError(UprightError):
    """Under these conditions the effect is not detectable at any size, so there is no multiple of a minimum."""


def levels(case: Case, detectable: Mapping[str, float]) -> dict[str, float]:
    """The levels of a case by effect; the sign of those that may have either one is determined by the seed.

    `detectable`: the minimum detectable sizes by effect. Raises NotDetectableError.
    """
    found = {}
    for name in case.effects:
        effect = (HIDDEN | UNLISTED)[name]
        least = detectable.get(name, math.nan)
        if not (math.isfinite(least) and least > 0.0):
            raise NotDetectableError(
                f"{name} is not detectable with {case.excitation} at any size.", remedy="Use another excitation."
            )
        sign = -1.0 if effect.signed and case.seed(f"sign of {name}") % 2 else 1.0
        found[name] = sign * case.size * least / abs(effect.size)
    return found


def plant_sizes(given: Mapping[str, float]) -> dict[str, float]:
    """The sizes by effect, in their own units."""
    return {name: level * (HIDDEN | UNLISTED)[name].size for name, level in given.items()}


def right_model(model: Model, given: Mapping[str, float], event: float) -> Model:
    """`model` with the effects of the plant, with its sizes and shapes; a torque step starts at `event` s.

    Effects outside the catalogue are taken from `unlisted`.
    """
    from upright.service.hidden_effects.unlisted import UNLISTED_EFFECTS

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
