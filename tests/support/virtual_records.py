"""Recordings of the virtual vehicle, and its true model, that several test modules use."""

from __future__ import annotations

import golden

from upright.models import library
from upright.models.model import Model
from upright.telemetry.recording import Recording

TRUTH = {"inertia": 1650.0, "gravity_stiffness": 14500.0}
"""True values of the independent plant; the other parameters are the same in plant and model."""


def multisine(*hide: str, seed: int = 8) -> Recording:
    """15 s of multisine between getting up and lying down."""
    return golden.recorded("monocab", "multisine", hide=hide, seed=seed, duration=15.0)


def true_model() -> Model:
    return library.get("monocab_roll").add("static_torque").change(TRUTH)
