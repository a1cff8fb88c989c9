"""The content of a model file: a model and its history."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from upright.models.model import Model


@dataclass(frozen=True, slots=True)
class ModelFile:
    """A model and its history, oldest first: one mapping per entry, with `action` and further details.

    `columns`: by channel, the column of a table that it is read from (`COLUMN` or `COLUMN:UNIT`).
    `effect_files`: for the user's own effects, by their name in the model, the path from the model file's folder.
    `actuators_file`: that of the file of the model of the actuators, "" if there is none.
    """

    model: Model
    history: tuple[Mapping[str, Any], ...] = ()
    effect_files: Mapping[str, str] = field(default_factory=dict)
    columns: Mapping[str, str] = field(default_factory=dict)
    actuators_file: str = ""
