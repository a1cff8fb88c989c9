"""From the layers: the definition of effects, and the base of all errors."""

from __future__ import annotations

from models.effect import Effect, EffectParameter, EffectState, Family, Role
from models.parts import Place
from telemetry.errors import UprightError

__all__ = [
    "Effect",
    "EffectParameter",
    "EffectState",
    "Family",
    "Place",
    "Role",
    "UprightError",
]
