"""Recordings of the virtual vehicle that several test modules use: each is made once, some 4 s."""

from __future__ import annotations

from functools import cache

from models import library
from models.model import Model
from service.virtual.run import record
from telemetry.recording import Recording

TRUTH = {"inertia": 1650.0, "gravity_stiffness": 14500.0}
"""Of the independent plant; what else the model names is the same in both."""


@cache
def multisine(*hide: str, seed: int = 8) -> Recording:
    return record("monocab", "multisine", hide=hide, seed=seed)


def true_model() -> Model:
    return library.get("monocab_roll").add("static_torque").change(TRUTH)
