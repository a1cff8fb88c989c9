"""A named effect: a term at a joint, on an actuator or on a sensor that is neutral if its amplitudes are zero.

An effect is independent of the machine. Its expressions use the names of the place it is attached to:

* at a joint: `coordinate`, `rate`, `inertia`, `load` (the force there without the effect, so that load / inertia is the
  acceleration), `time`, `smooth_rate` (a number); if the joint has an actuator, also `actuator_rate`, `actuator_angle`,
  `gain` (force per unit of actuator rate) and `actuator_inertia` (the actuator's own, a part of `inertia`). `force` is
  added to the joint's load. `twist` is how far the actuator is ahead of `coordinate`, in the same unit: the sensors on
  the actuator show it in addition to the joint's motion.
* on an actuator: `command`, `time`, and `actuator_rate` and `actuator_angle` if the model knows them. The attribute
  `command` replaces the command; `delay` and `lag` name the parameters (s) by which the command is delayed or with
  which it passes a first-order lag.
* on a sensor: `angle`, `rate` (what the sensor would show), their time derivatives `angle_1`, `angle_2`, `rate_1`,
  `rate_2`, and `time`. `angle_reading` and `rate_reading` replace the readings; the reading of a quantity that the
  sensor does not measure is ignored. If the sensor has a `filter`, a term added to the rate alone passes through it
  into the angle. `delay` names the parameter (s) by which all readings are delayed: if the sensor shows all outputs of
  the model, the inputs that drive the model are delayed instead, which is exact.

At all of them `time_scale` is a number, the natural time of the model in s (models.natural_time): the durations in an
effect scale with it.

States and parameters have local names. In a model, a parameter is called EFFECT.NAME (EFFECT@PLACE.NAME at any place
other than the first one that supports the effect).
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from enum import StrEnum

from upright.models.parts import Parameter, Place, State
from upright.models.text.expressions import names_in


class Family(StrEnum):
    """Kinds of effects that leave similar traces in a record."""

    BIAS = "bias"
    DRY_FRICTION = "dry_friction"
    SPEED_DRAG = "speed_drag"
    STIFFNESS = "stiffness"
    TIME_SHIFT = "time_shift"
    GAIN = "gain"
    COUPLING = "coupling"
    PERIODIC = "periodic"
    MEMORY = "memory"
    STRUCTURE = "structure"
    SENSOR = "sensor"


class Role(StrEnum):
    """The kind of a parameter that shapes an effect: the search for effects derives start values from it."""

    SHAPE = "shape"
    FREQUENCY = "frequency"
    """Hz, of the spectral line or the mode that the effect causes."""
    INSTANT = "instant"
    """s since the first sample of a recording, when the effect sets in."""
    DURATION = "duration"
    """s, duration of the onset."""


@dataclass(frozen=True, slots=True)
class EffectParameter:
    """A parameter of an effect.

    An `amplitude` is zero if the effect is absent. All other parameters shape the effect, as their `role` says, and
    stay at `value` unless estimated.
    `value`, `scale`, `lower`, `upper` and `starts` are expressions of numbers and of the place's scales, and `unit` may
    use the place's units:

    * anywhere: time_scale
    * joint: force_scale, coordinate_scale, rate_scale, smooth_rate; {force}, {coordinate}
    * joint with an actuator, and actuator: these, command_scale, angle_scale; {command}, {angle}
    * sensor: angle_scale, rate_scale; {angle}, {rate}

    `starts` are further start values, for an error function with several minima.
    """

    name: str
    unit: str
    meaning: str
    amplitude: bool = False
    role: Role = Role.SHAPE
    value: str = "0"
    scale: str = ""
    lower: str = ""
    upper: str = ""
    starts: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class EffectState:
    """A state of an effect with memory, 0 at rest. `initial`: for a sensor, the reading (angle or rate) that the state
    equals at the first sample of a record. `spread`: standard deviation of the state at that sample, in the place's
    scales; for an oscillation that may be under way, which no single sample shows."""

    name: str
    unit: str
    derivative: str
    meaning: str = ""
    initial: str = ""
    spread: str = ""


@dataclass(frozen=True, slots=True)
class Effect:
    """One physical effect that a model may lack.

    `signature`: its trace in a record. `confused_with`: effects with almost the same trace. `separated_by`: the
    experiment that distinguishes them. `made_of`: two other effects that together do almost the same. `beyond`: other
    effects that do a part of what it does; it is detectable only by what it does beyond them. `dissipative`: it never
    adds energy. `impacts`: parts collide, so that its behaviour at a small amplitude says nothing about that at a
    larger one. `stiff`: its own motion is much faster than the sampling. `sets_in`: it may set in during a run; a
    property of the machine's construction does not. `onset_of`: the other effect of which it is the onset at one
    instant. `of_run`: an event of one run that its experiment asked for, and no property of the machine.
    `formula_error`: the share of what it explains that its formula may leave unexplained, or that a second effect may
    explain merely by bending the formula; 0 if the formula is exact, as for a constant. `in_radians`: names that must
    be angles in rad for the effect to make sense. `source`: origin of the equation. `instead`: the formula of the same
    effect for places that offer the names it needs. `finer`: a formula of the same effect with more physics and more
    parameters, which needs a more informative record.
    """

    name: str
    family: Family
    title: str
    place: Place
    equation: str
    """For people, as in a textbook; the expressions below are what is computed."""
    parameters: tuple[EffectParameter, ...]
    signature: str
    confused_with: tuple[str, ...]
    separated_by: str
    force: str = ""
    twist: str = ""
    command: str = ""
    delay: str = ""
    lag: str = ""
    angle_reading: str = ""
    rate_reading: str = ""
    states: tuple[EffectState, ...] = ()
    made_of: tuple[str, ...] = ()
    beyond: tuple[str, ...] = ()
    dissipative: bool = False
    impacts: bool = False
    stiff: bool = False
    sets_in: bool = True
    onset_of: str = ""
    of_run: bool = False
    formula_error: float = 0.1
    in_radians: tuple[str, ...] = ()
    source: str = ""
    instead: Effect | None = None
    finer: Effect | None = None

    @property
    def amplitudes(self) -> tuple[str, ...]:
        """Local names of the parameters that are zero if the effect is absent."""
        return tuple(parameter.name for parameter in self.parameters if parameter.amplitude)

    def with_parameters(self, names: Iterable[str]) -> Effect:
        """The effect in its finer formula if `names` (local) are not all parameters of this one."""
        strange = set(names) - {parameter.name for parameter in self.parameters}
        return self.finer if self.finer and strange else self

    @property
    def own_names(self) -> tuple[str, ...]:
        """Local names of its parameters and states."""
        return tuple(parameter.name for parameter in self.parameters) + tuple(state.name for state in self.states)

    @property
    def expressions(self) -> dict[str, str]:
        """Its expressions by key, those of its states included; `delay` and `lag` are names, not expressions."""
        texts = {key: getattr(self, key) for key in ("force", "twist", "command", "angle_reading", "rate_reading")}
        texts |= {f"{state.name}.derivative": state.derivative for state in self.states}
        return {key: text for key, text in texts.items() if text}

    @property
    def follows_time(self) -> bool:
        """Whether its action depends on the time of the run, as that of a torque step does."""
        return any("time" in names_in(text) for text in self.expressions.values())


@dataclass(frozen=True, slots=True)
class AttachedEffect:
    """An effect in a model: `name` is EFFECT, or EFFECT@PLACE; parameters and states have their names in the model;
    `time_scale` (s) is the value of that name in its expressions."""

    effect: Effect
    name: str
    at: str
    parameters: tuple[Parameter, ...]
    states: tuple[State, ...]
    time_scale: float

    def qualified(self, local: str) -> str:
        """The name in the model for the effect's `local` name."""
        return f"{self.name}.{local}"

    @property
    def amplitudes(self) -> tuple[str, ...]:
        """Names in the model of the parameters that are zero if the effect is absent."""
        return tuple(map(self.qualified, self.effect.amplitudes))

    def of_role(self, *roles: Role) -> tuple[str, ...]:
        """Names in the model of the parameters that have one of `roles`."""
        return tuple(self.qualified(each.name) for each in self.effect.parameters if each.role in roles)
