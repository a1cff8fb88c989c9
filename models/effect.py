"""What a named effect is: a term at a joint, on an actuator or on a sensor, neutral where its amplitudes are zero.

An effect knows no machine. Its expressions use the names of the place it is attached to:

* at a joint: `coordinate`, `rate`, `inertia`, `load` (the force there without the effect, so that load / inertia is the
  acceleration), `time`, `smooth_rate` (a number); where the joint has an actuator also `actuator_rate`,
  `actuator_angle`, `gain` (force a unit of actuator rate) and `actuator_inertia` (the actuator's own, a part of
  `inertia`). `force` is added to the joint's load. `twist` is by how much the actuator is ahead of `coordinate`, in
  the unit of that: what the sensors on it show more than the joint's motion.
* on an actuator: `command`, `time`, and `actuator_rate` and `actuator_angle` where the model knows them. `command` (the
  attribute) replaces the command; `delay` and `lag` name the parameters (s) by which it acts later or goes through a
  first-order lag.
* on a sensor: `angle`, `rate` (what the sensor would show), their time derivatives `angle_1`, `angle_2`, `rate_1`,
  `rate_2`, and `time`. `angle_reading` and `rate_reading` replace what it shows; one that the sensor does not measure
  is left out. Where the sensor has a `filter`, what is added to the rate alone goes through it into the angle. `delay`
  names the parameter (s) by which all that it shows is late: where that is all that the model shows, whatever drives
  the model acts later instead, which is exact.

At all of them `time_scale` is a number, the natural time of the model in s (models.natural_time): what an effect does
in seconds follows it.

States and parameters go by their local names. In a model a parameter is called EFFECT.NAME (EFFECT@PLACE.NAME at
another than the first place that can have the effect).
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from enum import StrEnum

from models.expressions import names_in
from models.parts import Parameter, Place, State


class Family(StrEnum):
    """Kinds of effects that look alike in a record."""

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
    """What a parameter that shapes an effect is: who looks for effects finds values to start from by it."""

    SHAPE = "shape"
    FREQUENCY = "frequency"
    """Hz, at which the effect shows as a line or a mode in a spectrum."""
    INSTANT = "instant"
    """s from the first row of a recording on, at which the effect sets in."""
    DURATION = "duration"
    """s that it takes to set in."""


@dataclass(frozen=True, slots=True)
class EffectParameter:
    """A parameter of an effect.

    An `amplitude` is zero where the effect is absent; all others shape it, as their `role` says, and keep `value`.
    `value`, `scale`, `lower`, `upper` and `starts` are expressions of numbers and of the place's scales, and `unit` may
    use the place's units:

    * anywhere: time_scale
    * joint: force_scale, coordinate_scale, rate_scale, smooth_rate; {force}, {coordinate}
    * joint with an actuator, and actuator: these and command_scale, angle_scale; {command}, {angle}
    * sensor: angle_scale, rate_scale; {angle}, {rate}

    `starts` are further values to start from where the error has several minima.
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
    """A state of an effect with memory, at rest at 0. `initial`: of a sensor's, the reading (angle or rate) that it has
    at the first row of a record. `spread`: standard deviation of what it may be there, in the place's scales; of what
    goes on swinging, as no row tells."""

    name: str
    unit: str
    derivative: str
    meaning: str = ""
    initial: str = ""
    spread: str = ""


@dataclass(frozen=True, slots=True)
class Effect:
    """One physical effect that a model may lack.

    `signature`: what it leaves in a record. `confused_with`: effects that leave almost the same. `separated_by`:
    which experiment tells them apart. `made_of`: two others that do almost the same together. `beyond`: others that
    do a part of what it does; it is detectable by what it does beyond them. `dissipative`: it never adds energy.
    `impacts`: parts collide, so that what a little of it does says nothing of what more of it does.
    `stiff`: its own motion is much faster than a row. `sets_in`: it may set in during a run; how a machine is built
    does not. `onset_of`: the other effect that it is, begun at an instant. `formula_error`: the share of what it
    explains that its formula may leave, or that a second name may merely bend; 0 where a constant is a constant.
    `in_radians`: names that are an angle in rad, or the effect makes no sense. `source` is where the equation is
    from. `instead`: the formula of the same effect at places that offer what that one asks for. `finer`: a formula
    of the same effect with more physics and more parameters, which takes more of a record to tell.
    """

    name: str
    family: Family
    title: str
    place: Place
    equation: str
    """As one would write it in a text, for people; the expressions below are what is computed."""
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
    formula_error: float = 0.1
    in_radians: tuple[str, ...] = ()
    source: str = ""
    instead: Effect | None = None
    finer: Effect | None = None

    @property
    def amplitudes(self) -> tuple[str, ...]:
        """Local names of the parameters that are zero where the effect is absent."""
        return tuple(parameter.name for parameter in self.parameters if parameter.amplitude)

    def with_parameters(self, names: Iterable[str]) -> Effect:
        """It by its finer formula, where `names` (local) are not all of this one's parameters."""
        strange = set(names) - {parameter.name for parameter in self.parameters}
        return self.finer if self.finer and strange else self

    @property
    def own_names(self) -> tuple[str, ...]:
        """Local names of its parameters and states."""
        return tuple(parameter.name for parameter in self.parameters) + tuple(state.name for state in self.states)

    @property
    def expressions(self) -> dict[str, str]:
        """Key to text of the expressions it has, its states' included; `delay` and `lag` are names, not expressions."""
        texts = {key: getattr(self, key) for key in ("force", "twist", "command", "angle_reading", "rate_reading")}
        texts |= {f"{state.name}.derivative": state.derivative for state in self.states}
        return {key: text for key, text in texts.items() if text}

    @property
    def follows_time(self) -> bool:
        """Whether what it does depends on the time of the run, as a torque that sets in does."""
        return any("time" in names_in(text) for text in self.expressions.values())


@dataclass(frozen=True, slots=True)
class AttachedEffect:
    """An effect in a model: `name` is EFFECT, or EFFECT@PLACE; parameters and states go by their names in the model;
    `time_scale` s is the number that its expressions have by this name."""

    effect: Effect
    name: str
    at: str
    parameters: tuple[Parameter, ...]
    states: tuple[State, ...]
    time_scale: float

    def qualified(self, local: str) -> str:
        """The name in the model of what the effect calls `local`."""
        return f"{self.name}.{local}"

    @property
    def amplitudes(self) -> tuple[str, ...]:
        """Names in the model of the parameters that are zero where the effect is absent."""
        return tuple(map(self.qualified, self.effect.amplitudes))

    def of_role(self, *roles: Role) -> tuple[str, ...]:
        """Names in the model of the parameters that shape it as one of `roles`."""
        return tuple(self.qualified(each.name) for each in self.effect.parameters if each.role in roles)
