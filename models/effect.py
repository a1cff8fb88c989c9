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

import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from enum import StrEnum

from models.expressions import check, names_in, number
from models.model import Actuator, Joint, Model, ModelError, Parameter, Sensor, State
from models.natural_time import USUAL, rounded
from models.place import VOCABULARY, offer
from models.place import Place as Place
from models.place import places_of as places_of
from models.sensing import BEGUN, FILTERED, integrated

BELONGING: Mapping[Place, tuple[str, ...]] = {
    Place.JOINT: ("force", "twist"),
    Place.ACTUATOR: ("command", "delay", "lag"),
    Place.SENSOR: ("angle_reading", "rate_reading", "delay"),
}
"""Which attributes of an effect say what it does at its place."""

_ARTICLE = {Place.JOINT: "a joint", Place.ACTUATOR: "an actuator", Place.SENSOR: "a sensor"}


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


@dataclass(frozen=True, slots=True)
class EffectParameter:
    """A parameter of an effect.

    An `amplitude` is zero where the effect is absent; all others shape it and keep `value`. `value`, `scale`, `lower`,
    `upper` and `starts` are expressions of numbers and of the place's scales, and `unit` may use the place's units:

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

    `signature`: what it leaves in a record. `confused_with`: effects that leave almost the same. `separated_by`: which
    experiment tells them apart. `made_of`: two others that do almost the same together. `beyond`: others that do a part
    of what it does; it is detectable by what it does beyond them. `dissipative`: it never adds energy. `strikes`: parts
    strike each other, so that what a little of it does says nothing of what more of it does. `in_radians`: names that
    are an angle in rad, or the effect makes no sense. `source` is where the equation is from. `instead`: the formula of
    the same effect at places that offer what that one asks for. `finer`: a formula of the same effect with more physics
    and more parameters, which takes more of a record to tell.
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
    strikes: bool = False
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
    time_scale: float = USUAL

    def qualified(self, local: str) -> str:
        """The name in the model of what the effect calls `local`."""
        return f"{self.name}.{local}"

    @property
    def amplitudes(self) -> tuple[str, ...]:
        """Names in the model of the parameters that are zero where the effect is absent."""
        return tuple(map(self.qualified, self.effect.amplitudes))


def attach(model: Model, effect: Effect | str, at: str = "") -> AttachedEffect:
    """`effect` as part of `model` at the place `at`, by default the first that can have it.

    Raises ModelError where there is no such effect or place, the place lacks what the effect needs, an expression uses
    a name that does not exist, or the effect is there already.
    """
    if isinstance(effect, str):
        from models.effects import find

        effect = find(effect)
    check_names(effect)
    place, first = _place(model, effect, at)
    name = effect.name if place.name == first else f"{effect.name}@{place.name}"
    if any(attached.name == name for attached in model.effects):
        remedy = "change its parameters instead."
        raise ModelError(f"effect {name}", f"model {model.name} has it already", remedy=remedy)
    offered = offer(model, place)
    effect = _formula(model, effect, place)
    bare = AttachedEffect(effect, name, place.name, (), (), offered.scales["time_scale"])
    parameters = []
    for parameter in effect.parameters:
        where = f"effect {effect.name}, parameter {parameter.name}"
        parameters.append(
            Parameter(
                name=bare.qualified(parameter.name),
                unit=_unit(parameter.unit, offered.units, where),
                value=rounded(number(parameter.value, offered.scales, f"{where}, value")),
                scale=rounded(number(parameter.scale, offered.scales, f"{where}, scale")) if parameter.scale else 0.0,
                lower=rounded(number(parameter.lower, offered.scales, f"{where}, lower"))
                if parameter.lower
                else -math.inf,
                upper=rounded(number(parameter.upper, offered.scales, f"{where}, upper"))
                if parameter.upper
                else math.inf,
                estimated=parameter.amplitude,
                meaning=parameter.meaning,
            )
        )
    states = tuple(
        State(
            bare.qualified(state.name),
            _unit(state.unit, offered.units, f"effect {effect.name}, state {state.name}"),
            state.derivative,
            initial=_shown(place, state.initial) or "0",
            initial_std=number(state.spread, offered.scales, f"state {state.name}, spread") if state.spread else 0.0,
            meaning=state.meaning,
        )
        for state in effect.states
    )
    if isinstance(place, Sensor) and integrated(place, effect):
        units = (place.angle_unit, place.rate_unit, place.angle_unit)
        scales = (place.angle_scale, place.rate_scale, place.angle_scale)
        states += tuple(
            State(
                bare.qualified(name),
                unit,
                text,
                initial_std=BEGUN * scale,
                meaning="error of the filter that makes the angle from the rate",
            )
            for (name, text), unit, scale in zip(FILTERED.items(), units, scales, strict=True)
        )
    return replace(bare, parameters=tuple(parameters), states=states)


def starts(model: Model, attached: AttachedEffect, name: str) -> tuple[float, ...]:
    """Values to start its parameter (local `name`) from: its own value first, then those of `starts`, in its unit.

    Raises ModelError where the effect has no such parameter.
    """
    for parameter in attached.effect.parameters:
        if parameter.name == name:
            place = next(each for each in places_of(model, attached.effect.place) if each.name == attached.at)
            scales = offer(model, place).scales
            where = f"effect {attached.effect.name}, parameter {name}, starts"
            return tuple(rounded(number(text, scales, where)) for text in (parameter.value, *parameter.starts))
    there = ", ".join(parameter.name for parameter in attached.effect.parameters)
    raise ModelError(f"effect {attached.name}", f"there is no parameter {name!r}", remedy=f"use one of: {there}.")


def check_names(effect: Effect) -> None:
    """Raises ModelError unless the expressions belong to the effect's kind of place and use only what that offers."""
    own = frozenset(effect.own_names)
    belonging = BELONGING[effect.place]
    strange = [key for keys in BELONGING.values() for key in keys if getattr(effect, key) and key not in belonging]
    if effect.states and effect.place is Place.ACTUATOR:
        strange.append("states")
    if strange:
        what = f"is on {_ARTICLE[effect.place]}, where {strange[0]} means nothing"
        raise ModelError(f"effect {effect.name}", what, remedy=f"there it has {' or '.join(belonging)}.")
    if not any(getattr(effect, key) for key in belonging):
        raise ModelError(f"effect {effect.name}", "does nothing", remedy=f"give it {' or '.join(belonging)}.")
    for key, text in effect.expressions.items():
        more = {"force"} if key.endswith(".derivative") else set()
        check(text, VOCABULARY[effect.place] | own | more, f"effect {effect.name}, {key}")
    for state in effect.states:
        if state.initial and not (effect.place is Place.SENSOR and state.initial in ("angle", "rate")):
            remedy = "a sensor's state may begin with its angle or its rate, all others at rest."
            raise ModelError(
                f"effect {effect.name}, state {state.name}", f"cannot begin with {state.initial!r}", remedy=remedy
            )
    for key, name in (("delay", effect.delay), ("lag", effect.lag)):
        if name and name not in own:
            remedy = f"name one of its parameters: {', '.join(effect.own_names)}."
            raise ModelError(f"effect {effect.name}, {key}", f"there is no parameter {name!r}", remedy=remedy)


def places_for(model: Model, effect: Effect) -> tuple[str, ...]:
    """The names of all places where `model` can have the effect. Raises ModelError where there is none."""
    _, able = _places(model, effect)
    if not able:
        _place(model, effect, "")
    return able


def _places(
    model: Model, effect: Effect
) -> tuple[Mapping[str, tuple[Joint | Actuator | Sensor, str]], tuple[str, ...]]:
    """The places of the effect's kind with what each lacks, in words, and the names of those that lack nothing."""
    places = {
        place.name: (place, ", ".join(_lacks(model, _formula(model, effect, place), place)))
        for place in places_of(model, effect.place)
    }
    return places, tuple(name for name, (_, lack) in places.items() if not lack)


def _place(model: Model, effect: Effect, at: str) -> tuple[Joint | Actuator | Sensor, str]:
    """Where the effect goes, and the first place that could have it. Raises ModelError."""
    places, able = _places(model, effect)
    if not places:
        remedy = f"model {model.name} cannot have this effect."
        what = f"needs {_ARTICLE[effect.place]}, and the model has none"
        if effect.place is Place.ACTUATOR and model.actuators:
            names = ", ".join(each.name for each in model.actuators)
            what = "acts on a command, and the model says that its actuators move exactly as it was measured"
            remedy = f"remove commanded = false from {names}, or use a model that is driven by the command."
        raise ModelError(f"effect {effect.name}", what, remedy=remedy)
    if at and at not in places:
        there = ", ".join(places)
        raise ModelError(
            f"effect {effect.name}", f"there is no {effect.place.value} {at!r}", remedy=f"use one of: {there}."
        )
    asked = at or (able[0] if able else next(iter(places)))
    place, lack = places[asked]
    if lack:
        remedy = f"attach it at {' or '.join(able)}." if able else f"model {model.name} cannot have this effect."
        what = f"needs {lack}, which {effect.place.value} {asked} does not have"
        raise ModelError(f"effect {effect.name}", what, remedy=remedy)
    return place, able[0]


def _formula(model: Model, effect: Effect, place: Joint | Actuator | Sensor) -> Effect:
    """`effect` as it is at `place`."""
    return effect.instead if effect.instead and not any(_lacks(model, effect.instead, place)) else effect


def _lacks(model: Model, effect: Effect, place: Joint | Actuator | Sensor) -> Iterator[str]:
    """What the effect needs and `place` does not have."""
    offered = offer(model, place)
    texts = effect.expressions
    if isinstance(place, Sensor):
        readings = {"angle_reading": place.angle, "rate_reading": place.rate}
        texts = {key: text for key, text in texts.items() if readings.get(key)}
        if not texts:
            yield " or ".join(sorted(key.removesuffix("_reading") for key in effect.expressions))
    needed = {name for text in texts.values() for name in names_in(text)} & VOCABULARY[effect.place]
    yield from sorted(needed - offered.names)
    for name in effect.in_radians:
        if name in offered.names and name not in offered.in_radians:
            yield f"{name} in rad"


def _shown(place: Joint | Actuator | Sensor, reading: str) -> str:
    """The output that is `reading` of a sensor, empty where it has none."""
    return {"angle": place.angle, "rate": place.rate}.get(reading, "") if isinstance(place, Sensor) else ""


def _unit(template: str, units: Mapping[str, str], where: str) -> str:
    try:
        return template.format_map(units)
    except (KeyError, ValueError, IndexError, AttributeError) as error:
        there = ", ".join(f"{{{name}}}" for name in units)
        raise ModelError(where, f"unit {template!r} cannot be filled in ({error})", remedy=f"use {there}.") from error
