"""From the layers: the definition of effects, and the base of all errors."""

from __future__ import annotations

from upright.models.effect import Effect, EffectParameter, EffectState, Family, Role
from upright.models.parts import Place
from upright.telemetry.errors import UprightError

__all__ = [
    "Effect",
    "EffectParameter",
    "EffectState",
    "Family",
    "Place",
    "Role",
    "UprightError",
]
