"""The shipped models, by name. `get("monocab_roll")` returns one; nothing here imports SymPy or numba.

Models of no particular vehicle are beside this file; a vehicle's models are the `MODELS` of the module `model` in its
folder.
"""

from __future__ import annotations

from upright.models.library.axis import AXIS
from upright.models.model import Model
from upright.models.parts import ModelError
from upright.telemetry.vehicle_modules import each_with

MODELS: dict[str, Model] = {model.name: model for module in each_with("model").values() for model in module.MODELS} | {
    AXIS.name: AXIS
}


def get(name: str) -> Model:
    """The shipped model `name`. Raises ModelError, which lists the available names."""
    if name not in MODELS:
        raise ModelError(f"model {name}", "there is no such model", remedy=f"use one of: {', '.join(MODELS)}.")
    return MODELS[name]
