"""Attaches an effect to a model: finds its place and names its parameters, states and units there."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import replace

from upright.models.effect import AttachedEffect, Effect
from upright.models.effects.catalogue import find
from upright.models.grey_box import GreyBox
from upright.models.natural_time import rounded
from upright.models.parts import Actuator, Joint, ModelError, Parameter, Place, Sensor, State
from upright.models.place import VOCABULARY, offer, places_of
from upright.models.sensing import BEGUN, FILTERED, integrated
from upright.models.text.expressions import check, names_in, number

BELONGING: Mapping[Place, tuple[str, ...]] = {
    Place.JOINT: ("force", "twist"),
    Place.ACTUATOR: ("command", "delay", "lag"),
    Place.SENSOR: ("angle_reading", "rate_reading", "delay"),
}
"""The attributes that define the action of an effect, by the kind of its place."""

_ARTICLE = {Place.JOINT: "a joint", Place.ACTUATOR: "an actuator", Place.SENSOR: "a sensor"}


def attach(model: GreyBox, effect: Effect | str, at: str = "") -> AttachedEffect:
    """`effect` as part of `model` at the place `at`, by default the first one that supports it.

    Raises ModelError if there is no such effect or place, the place lacks what the effect needs, an expression uses an
    unknown name, or the model has the effect already.
    """
    if isinstance(effect, str):
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
                meaning="error of the filter that computes the angle from the rate",
            )
            for (name, text), unit, scale in zip(FILTERED.items(), units, scales, strict=True)
        )
    return replace(bare, parameters=tuple(parameters), states=states)


def starts(model: GreyBox, attached: AttachedEffect, name: str) -> tuple[float, ...]:
    """Start values of its parameter (local `name`), in its unit: first the default value, then those of `starts`.

    Raises ModelError if the effect has no such parameter.
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
    """Raises ModelError unless the expressions belong to the effect's kind of place and use only its names."""
    own = frozenset(effect.own_names)
    belonging = BELONGING[effect.place]
    strange = [key for keys in BELONGING.values() for key in keys if getattr(effect, key) and key not in belonging]
    if effect.states and effect.place is Place.ACTUATOR:
        strange.append("states")
    if strange:
        what = f"is on {_ARTICLE[effect.place]}, where {strange[0]} has no meaning"
        raise ModelError(f"effect {effect.name}", what, remedy=f"use {' or '.join(belonging)}.")
    if not any(getattr(effect, key) for key in belonging):
        raise ModelError(f"effect {effect.name}", "does nothing", remedy=f"give it {' or '.join(belonging)}.")
    for key, text in effect.expressions.items():
        more = {"force"} if key.endswith(".derivative") else set()
        check(text, VOCABULARY[effect.place] | own | more, f"effect {effect.name}, {key}")
    for state in effect.states:
        if state.initial and not (effect.place is Place.SENSOR and state.initial in ("angle", "rate")):
            remedy = "a sensor's state may begin with its angle or its rate; all other states begin at 0."
            raise ModelError(
                f"effect {effect.name}, state {state.name}", f"cannot begin with {state.initial!r}", remedy=remedy
            )
    for key, name in (("delay", effect.delay), ("lag", effect.lag)):
        if name and name not in own:
            remedy = f"name one of its parameters: {', '.join(effect.own_names)}."
            raise ModelError(f"effect {effect.name}, {key}", f"there is no parameter {name!r}", remedy=remedy)


def places_for(model: GreyBox, effect: Effect) -> tuple[str, ...]:
    """The names of all places where `model` can have the effect. Raises ModelError if there is none."""
    _, able = _places(model, effect)
    if not able:
        _place(model, effect, "")
    return able


def _places(
    model: GreyBox, effect: Effect
) -> tuple[Mapping[str, tuple[Joint | Actuator | Sensor, str]], tuple[str, ...]]:
    """The places of the effect's kind, each with a text of what it lacks, and the names of those that lack nothing."""
    places = {
        place.name: (place, ", ".join(_lacks(model, _formula(model, effect, place), place)))
        for place in places_of(model, effect.place)
    }
    return places, tuple(name for name, (_, lack) in places.items() if not lack)


def _place(model: GreyBox, effect: Effect, at: str) -> tuple[Joint | Actuator | Sensor, str]:
    """The place of the effect, and the name of the first place that supports it. Raises ModelError."""
    places, able = _places(model, effect)
    if not places:
        remedy = f"model {model.name} cannot have this effect."
        what = f"needs {_ARTICLE[effect.place]}, but the model has none"
        if effect.place is Place.ACTUATOR and model.actuators:
            names = ", ".join(each.name for each in model.actuators)
            what = "acts on a command, but the model takes the motion of its actuators as measured"
            remedy = f"remove commanded = false from {names}, or use a model that is driven by the command."
        raise ModelError(f"effect {effect.name}", what, remedy=remedy)
    if at and at not in places:
        there = ", ".join(places)
        raise ModelError(
            f"effect {effect.name}", f"there is no {effect.place.value} {at!r}", remedy=f"use one of: {there}."
        )
    chosen = at or (able[0] if able else next(iter(places)))
    place, lack = places[chosen]
    if lack:
        remedy = f"attach it at {' or '.join(able)}." if able else f"model {model.name} cannot have this effect."
        what = f"needs {lack}, which {effect.place.value} {chosen} does not have"
        raise ModelError(f"effect {effect.name}", what, remedy=remedy)
    return place, able[0]


def _formula(model: GreyBox, effect: Effect, place: Joint | Actuator | Sensor) -> Effect:
    """`effect`, or its formula `instead` if `place` has everything that formula needs."""
    return effect.instead if effect.instead and not any(_lacks(model, effect.instead, place)) else effect


def _lacks(model: GreyBox, effect: Effect, place: Joint | Actuator | Sensor) -> Iterator[str]:
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
    """The output that is the `reading` (angle or rate) of a sensor; empty if it has none."""
    return {"angle": place.angle, "rate": place.rate}.get(reading, "") if isinstance(place, Sensor) else ""


def _unit(template: str, units: Mapping[str, str], where: str) -> str:
    try:
        return template.format_map(units)
    except (KeyError, ValueError, IndexError, AttributeError) as error:
        there = ", ".join(f"{{{name}}}" for name in units)
        raise ModelError(where, f"unit {template!r} cannot be filled in ({error})", remedy=f"use {there}.") from error
