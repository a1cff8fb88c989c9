"""The catalogue: every named effect that a model may lack, one file per family. Importing it computes nothing.

`find("coulomb_friction")` returns one; `Model.add` takes the name. User-defined effects: `models.file.own_effects`.
"""

from __future__ import annotations

import difflib

from upright.models.effect import Effect, Family
from upright.models.effects import (
    bias,
    coupling,
    dry_friction,
    gain,
    memory,
    periodic,
    sensor,
    speed_drag,
    stiffness,
    structure,
    time_shift,
)
from upright.models.parts import ModelError

_ALL = (
    bias.STATIC_TORQUE,
    speed_drag.VISCOUS_FRICTION,
    dry_friction.COULOMB_FRICTION,
    dry_friction.STRIBECK_FRICTION,
    dry_friction.LOAD_DEPENDENT_FRICTION,
    dry_friction.ASYMMETRIC_FRICTION,
    speed_drag.QUADRATIC_DRAG,
    stiffness.CUBIC_STIFFNESS,
    stiffness.GRAVITY_NONLINEARITY,
    stiffness.END_STOP,
    memory.HYSTERESIS,
    memory.BACKLASH,
    gain.INPUT_DEADBAND,
    time_shift.INPUT_DELAY,
    time_shift.ACTUATOR_LAG,
    gain.INPUT_ASYMMETRY,
    gain.INPUT_GAIN,
    coupling.GIMBAL_ANGLE_COUPLING,
    coupling.GIMBAL_IMBALANCE,
    periodic.PERIODIC_DISTURBANCE,
    periodic.POSITION_COGGING,
    bias.TORQUE_STEP,
    bias.TORQUE_DRIFT,
    structure.FLEXIBLE_MODE,
    sensor.GYRO_BIAS,
    sensor.SENSOR_OFFSET,
    sensor.SENSOR_LAG,
    sensor.SENSOR_DELAY,
    sensor.SENSOR_SCALE,
)

CATALOGUE: dict[str, Effect] = {effect.name: effect for effect in _ALL}
"""Canonical name to effect."""


def find(name: str) -> Effect:
    """The effect `name` of the catalogue. Raises ModelError, which suggests similar names."""
    if name in CATALOGUE:
        return CATALOGUE[name]
    close = difflib.get_close_matches(name, CATALOGUE, n=3)
    remedy = f"did you mean {' or '.join(close)}?" if close else f"use one of: {', '.join(CATALOGUE)}."
    raise ModelError(f"effect {name}", "there is no effect of this name", remedy=remedy)


def families() -> dict[Family, tuple[Effect, ...]]:
    """The effects of each family, both in the order of their definition."""
    return {family: tuple(effect for effect in _ALL if effect.family is family) for family in Family}
