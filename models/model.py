"""The grey-box model for general use: its definition (models.grey_box), and the method that adds effects to it."""

from __future__ import annotations

from dataclasses import dataclass, replace

from upright.models.attach import attach
from upright.models.effect import Effect
from upright.models.grey_box import GreyBox


@dataclass(frozen=True, slots=True)
class Model(GreyBox):
    """A model as described in models.grey_box, to which effects can be added.

    `actuators_model` is that of the actuators alone, from their command to the motion that is an input of this one: the
    effects on the way of a command are in it. None if there is none, or this model has the actuators itself.
    """

    actuators_model: Model | None = None

    def add(self, effect: Effect | str, at: str = "") -> Model:
        """The model with `effect` (a name stands for an effect of the catalogue) at the joint, actuator or sensor `at`
        (by default the first one that supports it).

        Raises ModelError if there is no such effect, the model has it already, or the model has no place for it.
        """
        return replace(self, effects=(*self.effects, attach(self, effect, at)))
