"""A grey-box model: equations as text, with the names, units, start values and bounds of all their quantities.

    state' = derivative(states, inputs, parameters, time),    output = expression(states, inputs, parameters, time)

Expressions are text (see models.text.expressions for what they may contain), so that a model is plain data: it can be
read from a TOML file, hashed, compared and printed, and it is cheap to import. `models.compiler.kernel` compiles it.

Besides states, inputs, parameters and `time` (s), an expression may use a name from `definitions`, `INPUT_slope` (the
slope of an input that is interpolated by a curve) and `JOINT_force`, the total generalised force at a joint: its own
`load` and the forces of the effects (models.effect).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Self

from upright.models.effect import AttachedEffect
from upright.models.parts import Actuator, Input, Joint, ModelError, Output, Parameter, Sensor, State


@dataclass(frozen=True, slots=True)
class GreyBox:
    """A model without the method that adds effects (models.model). `base_parameters` and `base_states` are its own,
    `effects` those that were added.

    The search for effects omits the first `settling` s of free motion, in which the filters of the measurements have
    not settled yet: the equations do not describe this transient.
    """

    name: str
    title: str
    base_states: tuple[State, ...]
    inputs: tuple[Input, ...]
    outputs: tuple[Output, ...]
    base_parameters: tuple[Parameter, ...]
    joints: tuple[Joint, ...] = ()
    actuators: tuple[Actuator, ...] = ()
    sensors: tuple[Sensor, ...] = ()
    definitions: Mapping[str, str] = field(default_factory=dict)
    source: str = ""
    settling: float = 0.0
    effects: tuple[AttachedEffect, ...] = ()

    @property
    def states(self) -> tuple[State, ...]:
        """All states, those of effects with memory last."""
        return self.base_states + tuple(state for attached in self.effects for state in attached.states)

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """All parameters, those of effects last."""
        return self.base_parameters + tuple(p for attached in self.effects for p in attached.parameters)

    @property
    def values(self) -> dict[str, float]:
        """Parameter name to value."""
        return {parameter.name: parameter.value for parameter in self.parameters}

    def parameter(self, name: str) -> Parameter:
        """Parameter `name`. Raises ModelError, which lists the available names."""
        for parameter in self.parameters:
            if parameter.name == name:
                return parameter
        names = ", ".join(p.name for p in self.parameters)
        raise ModelError(
            f"parameter {name}", f"model {self.name} has no such parameter", remedy=f"use one of: {names}."
        )

    def change(
        self,
        values: Mapping[str, float] | None = None,
        *,
        deviations: Mapping[str, float] | None = None,
        estimated: Iterable[str] | None = None,
    ) -> Self:
        """The model with other parameter values, prior standard deviations, or another set of estimated parameters.

        Raises ModelError for a name that the model does not have.
        """
        values, deviations = values or {}, deviations or {}
        chosen = None if estimated is None else frozenset(estimated)
        for name in {*values, *deviations, *(chosen or ())}:
            self.parameter(name)

        def changed(parameter: Parameter) -> Parameter:
            name = parameter.name
            return replace(
                parameter,
                value=float(values.get(name, parameter.value)),
                std=float(deviations.get(name, parameter.std)),
                estimated=parameter.estimated if chosen is None else name in chosen,
            )

        return replace(
            self,
            base_parameters=tuple(map(changed, self.base_parameters)),
            effects=tuple(
                replace(attached, parameters=tuple(map(changed, attached.parameters))) for attached in self.effects
            ),
        )

    def remove(self, name: str) -> Self:
        """The model without the effect `name`. Raises ModelError if the model does not have it."""
        kept = tuple(attached for attached in self.effects if attached.name != name)
        if len(kept) == len(self.effects):
            there = ", ".join(attached.name for attached in self.effects) or "none"
            raise ModelError(f"effect {name}", f"model {self.name} does not have it", remedy=f"its effects: {there}.")
        return replace(self, effects=kept)
