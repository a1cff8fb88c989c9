"""What a model file holds: a model, and how it came about."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from models.model import Model


@dataclass(frozen=True, slots=True)
class ModelFile:
    """A model and its history, oldest first: one mapping an entry, with `action` and what else there is to say.

    `effect_files`: for effects of the user's own, by their name in the model, the path from the model file's folder.
    """

    model: Model
    history: tuple[Mapping[str, Any], ...] = ()
    effect_files: Mapping[str, str] = field(default_factory=dict)
