"""The models that are shipped, by name. `get("monocab_roll")` gives one; nothing here imports SymPy or numba."""

from __future__ import annotations

from models.library.axis import AXIS
from models.library.monocab import MONOCAB_FULL, MONOCAB_REDUCED, MONOCAB_ROLL
from models.library.monocab_gimbals import SPEED_LOOPS
from models.library.twsbr import TWSBR
from models.model import Model
from models.parts import ModelError

MODELS: dict[str, Model] = {
    model.name: model for model in (MONOCAB_ROLL, MONOCAB_REDUCED, MONOCAB_FULL, *SPEED_LOOPS, TWSBR, AXIS)
}


def get(name: str) -> Model:
    """The shipped model `name`. Raises ModelError that lists the names there are."""
    if name not in MODELS:
        raise ModelError(f"model {name}", "there is no such model", remedy=f"use one of: {', '.join(MODELS)}.")
    return MODELS[name]
