"""Recordings of the virtual vehicle that several test modules use: each is made once."""

from __future__ import annotations

from functools import cache

import golden

from models import library
from models.model import Model
from telemetry.recording import Recording

TRUTH = {"inertia": 1650.0, "gravity_stiffness": 14500.0}
"""True values of the independent plant; the other parameters are the same in plant and model."""


@cache
def multisine(*hide: str, seed: int = 8) -> Recording:
    return golden.recorded("monocab", "multisine", hide=hide, seed=seed, duration=15.0)


def true_model() -> Model:
    return library.get("monocab_roll").add("static_torque").change(TRUTH)
