"""The rules for every effect, the user's own and those of the catalogue, that is attached to a model."""

from __future__ import annotations

import random
from collections.abc import Iterator, Mapping
from string import Formatter

from upright.models.attach import check_names
from upright.models.effect import Effect, EffectParameter
from upright.models.effects.catalogue import CATALOGUE
from upright.models.parts import ModelError, Place
from upright.models.place import SCALES, UNITS, VOCABULARY
from upright.models.sensing import FILTERED
from upright.models.text.expressions import name_problem, number

_TRIES = 40
"""Random motions on which neutrality is tested; a term that is inactive in one is active in another."""
_NEUTRAL = {"force": "", "twist": "", "command": "command", "angle_reading": "angle", "rate_reading": "rate"}
"""The name that each expression must equal if the amplitudes are zero; "" for zero."""


def validate(effect: Effect) -> None:
    """Raises ModelError, which names the key, unless the effect can be computed and is neutral at zero amplitudes."""
    where = f"effect {effect.name}"
    if (problem := name_problem(effect.name)) or not effect.name.islower():
        what = f"{effect.name!r} {problem or 'is not in lower case'}"
        raise ModelError(f"{where}, name", what, remedy="choose a name like rail_friction.")
    _validate_own_names(effect, where)
    check_names(effect)
    for parameter in effect.parameters:
        _validate_parameter(effect.place, parameter, f"{where}, parameter {parameter.name}")
    for state in effect.states:
        _validate_unit(effect.place, state.unit, f"{where}, state {state.name}, unit")
    strangers = [name for name in effect.in_radians if name not in VOCABULARY[effect.place]]
    if strangers:
        remedy = f"use names of: {', '.join(sorted(VOCABULARY[effect.place]))}."
        raise ModelError(f"{where}, in_radians", f"there is no {strangers[0]!r} on {effect.place}s", remedy=remedy)
    onsets = (effect.onset_of,) if effect.onset_of else ()
    for name in (*effect.confused_with, *effect.made_of, *effect.beyond, *onsets):
        if name not in CATALOGUE or name == effect.name:
            remedy = f"name others of the catalogue: {', '.join(CATALOGUE)}."
            raise ModelError(f"{where}, confused_with", f"there is no other effect {name!r}", remedy=remedy)
    if not 0.0 <= effect.formula_error < 1.0:
        what = f"{effect.formula_error:g} is not a share, from 0 to below 1, of what the effect explains"
        raise ModelError(f"{where}, formula_error", what, remedy="0.1 is usual, 0 for an exact formula.")
    _validate_neutral(effect, where)
    for formula in (effect.instead, effect.finer):
        if formula:
            validate(formula)


def _validate_own_names(effect: Effect, where: str) -> None:
    seen: set[str] = set()
    for kind, part in [("parameter", p.name) for p in effect.parameters] + [("state", s.name) for s in effect.states]:
        problem = name_problem(part)
        if part in VOCABULARY[effect.place] | {"force", *FILTERED}:
            problem = f"is predefined for effects on {effect.place}s"
        if part in seen:
            problem = "is defined twice"
        if problem:
            raise ModelError(f"{where}, {kind} {part}", f"{part!r} {problem}", remedy="choose another name.")
        seen.add(part)
    if not effect.amplitudes:
        remedy = "mark the parameter that is zero if the effect is absent: amplitude = true."
        raise ModelError(f"{where}, parameters", "none is an amplitude", remedy=remedy)


def _validate_parameter(place: Place, parameter: EffectParameter, where: str) -> None:
    scales = _scales(place)
    _validate_unit(place, parameter.unit, f"{where}, unit")
    value = number(parameter.value, scales, f"{where}, value")
    lower = number(parameter.lower, scales, f"{where}, lower") if parameter.lower else value
    upper = number(parameter.upper, scales, f"{where}, upper") if parameter.upper else value
    starts = [number(start, scales, f"{where}, starts") for start in parameter.starts]
    if parameter.amplitude and value:
        raise ModelError(f"{where}, value", "an amplitude begins at 0", remedy="leave value out, and use starts.")
    if not parameter.scale or number(parameter.scale, scales, f"{where}, scale") <= 0.0:
        what = "a typical magnitude greater than 0 is needed"
        raise ModelError(f"{where}, scale", what, remedy="scale = 'force_scale', or a number.")
    for key, each in (("value", value), *(("starts", start) for start in starts)):
        if (parameter.lower and each < lower) or (parameter.upper and each > upper):
            raise ModelError(f"{where}, {key}", f"{each:g} is outside its bounds", remedy="change it or the bounds.")


def _validate_unit(place: Place, unit: str, where: str) -> None:
    remedy = f"write an SI unit, or one with {', '.join(f'{{{name}}}' for name in sorted(UNITS[place]))}."
    try:
        fields = [field for _, field, _, _ in Formatter().parse(unit) if field is not None]
    except ValueError as error:
        raise ModelError(where, f"{unit!r} cannot be filled in ({error})", remedy=remedy) from error
    for field in fields:
        if field not in UNITS[place]:
            raise ModelError(where, f"there is no {{{field}}} on {place}s", remedy=remedy)


def _validate_neutral(effect: Effect, where: str) -> None:
    for key, neutral in _NEUTRAL.items():
        text, computed = effect.expressions.get(key), 0
        if text is None:
            continue
        for values in _motions(effect):
            try:
                value = number(text, values, f"{where}, {key}")
            except ModelError:
                continue
            computed += 1
            expected = values[neutral] if neutral else 0.0
            if abs(value - expected) > 1e-12 * (1.0 + abs(expected)):
                what = f"is not {neutral or 0} if {' and '.join(effect.amplitudes)} is 0"
                raise ModelError(f"{where}, {key}", what, remedy="multiply the term that it adds by an amplitude.")
        if not computed:
            remedy = "it must be computable for values around 0, positive and negative."
            raise ModelError(f"{where}, {key}", "has no value at any of the motions tried", remedy=remedy)


def _scales(place: Place) -> dict[str, float]:
    """The scales of a place whose typical magnitudes are 1."""
    return {name: 0.01 if name == "smooth_rate" else 1.0 for name in SCALES[place]}


def _motions(effect: Effect) -> Iterator[Mapping[str, float]]:
    """Values of all names, small and large, random but reproducible; amplitudes of zero and scales of one."""
    source = random.Random(1)
    scales = _scales(effect.place)
    for _ in range(_TRIES):
        names = sorted(VOCABULARY[effect.place]) + [state.name for state in effect.states]
        values = {name: source.choice((-1.0, 1.0)) * 10.0 ** source.uniform(-5.0, 0.5) for name in names}
        values |= {"smooth_rate": 0.01, "inertia": 1.0, "time": source.uniform(0.0, 10.0)}
        values |= {parameter.name: number(parameter.value, scales) for parameter in effect.parameters}
        yield values
