"""A grey-box model, as everybody uses it: what it is made of (models.grey_box), and effects that are added to it."""

from __future__ import annotations

from dataclasses import dataclass, replace

from models.attach import attach
from models.effect import Effect
from models.grey_box import GreyBox


@dataclass(frozen=True, slots=True)
class Model(GreyBox):
    """What models.grey_box describes, and how it gets effects."""

    def add(self, effect: Effect | str, at: str = "") -> Model:
        """The model with `effect` (by name, one of the catalogue) at the joint, actuator or sensor `at` (by default its
        first).

        Raises ModelError where there is no such effect, it is there already, or the model has no place for it.
        """
        return replace(self, effects=(*self.effects, attach(self, effect, at)))
