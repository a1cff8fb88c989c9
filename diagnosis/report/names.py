"""Names and units for people, without what draws: its import takes longer than all else of a report."""

from __future__ import annotations

import numpy as np

from upright.models.model import Model


def shown(unit: str) -> tuple[float, str]:
    """Factor and unit in which people read it: angles in degrees."""
    if unit.startswith("rad"):
        return float(np.degrees(1.0)), unit.replace("rad", "deg", 1)
    return 1.0, unit


def units(model: Model) -> dict[str, str]:
    """Units of a model's inputs and outputs, by name."""
    return {each.name: each.unit for each in model.inputs} | {each.name: each.unit for each in model.outputs}


def file_name(source: str) -> str:
    """The last part of a path."""
    return source.replace("\\", "/").rsplit("/", 1)[-1]
