"""Hidden effects: what a virtual vehicle may contain that the nominal model lacks, and how they are requested.

Names are the canonical effect names. Each kind of vehicle has a registry of its own, in its folder.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, fields, replace
from typing import TypeVar

from upright.simulation.physics.disturbance import Disturbance
from upright.simulation.physics.narrow_band import NarrowBand
from upright.telemetry.errors import UprightError


class UnknownEffectError(UprightError):
    """No hidden effect has this name, or it cannot have this level. `name` is the requested one."""

    def __init__(self, name: str, message: str, *, remedy: str) -> None:
        super().__init__(message, remedy=remedy)
        self.name = name


@dataclass(frozen=True, slots=True)
class HiddenEffect:
    """One effect: amplitude `size` in `unit` at level 1, at most `most`. `signed`: a negative level makes sense."""

    name: str
    unit: str
    size: float
    meaning: str
    signed: bool = False
    most: float = math.inf


DISTURBANCE = "disturbance"
"""Name of the random torque, next to those of the effects."""
NARROW_BAND = "narrow_band"
"""Name of the random torque of a narrow band."""
UNITS = {DISTURBANCE: "s", NARROW_BAND: "Hz"}
"""Of the second number of each; the first is an RMS."""
Random = TypeVar("Random", Disturbance, NarrowBand)


@dataclass(frozen=True, slots=True)
class Registry:
    """The effects that can be hidden in a kind of vehicle: those in a catalogue, those in none, and the late ones."""

    listed: Mapping[str, HiddenEffect]
    unlisted: Mapping[str, HiddenEffect]
    late: frozenset[str]
    """Names of the effects that can set in during a run."""
    disturbance: Disturbance
    """The random torque at level 1."""
    narrow_band: NarrowBand
    """The random torque of a narrow band at level 1."""

    def find(self, name: str) -> HiddenEffect:
        """The effect `name`. Raises UnknownEffectError."""
        effect = self.listed.get(name) or self.unlisted.get(name)
        if effect is None:
            there = ", ".join((*self.listed, DISTURBANCE, NARROW_BAND))
            raise UnknownEffectError(name, f"there is no hidden effect {name!r}.", remedy=f"Use one of: {there}.")
        return effect


def parse_disturbance(
    arguments: Iterable[str], registry: Registry, default: Disturbance | None = None
) -> tuple[list[str], Disturbance | None]:
    """The `arguments` that are not about the disturbance, for `parse_hidden`; and the requested disturbance.

    `disturbance` is level 1, `disturbance=LEVEL` a multiple of its RMS, `disturbance=RMS,CORRELATION_TIME` is in N m
    and s; each may end in `@SECONDS`. None with `disturbance=0`; `default` if no argument is about it. The last one
    counts. Raises UnknownEffectError.
    """
    return _parsed(arguments, DISTURBANCE, registry.disturbance, default)


def parse_narrow_band(arguments: Iterable[str], registry: Registry) -> tuple[list[str], NarrowBand | None]:
    """The same for the random torque of a narrow band, `narrow_band=RMS,FREQUENCY,DAMPING` in N m and Hz."""
    return _parsed(arguments, NARROW_BAND, registry.narrow_band, None)


def _parsed(
    arguments: Iterable[str], name: str, usual: Random, default: Random | None
) -> tuple[list[str], Random | None]:
    others: list[str] = []
    found = default
    for argument in arguments:
        if argument.partition("@")[0].partition("=")[0] == name:
            found = _random(argument, name, usual)
        else:
            others.append(argument)
    return others, found


def _random(argument: str, name: str, usual: Random) -> Random | None:
    """`name`, `name=LEVEL` or `name=NUMBER,...` with the numbers of `usual`, the RMS first; None if that is 0."""
    text, late, second = argument.partition("@")
    _, separator, value = text.partition("=")
    numbered = [each.name for each in fields(usual)][:-1]
    try:
        numbers = [float(word) for word in value.split(",")] if separator else [1.0]
        onset = float(second) if late else None
        if len(numbers) == 1:
            return replace(usual, rms=usual.rms * numbers[0], onset=onset) if numbers[0] != 0.0 else None
        given = dict(zip(numbered, numbers, strict=True))
        return replace(usual, **given, onset=onset) if numbers[0] != 0.0 else None
    except ValueError as error:
        why = str(error) if str(error).startswith("the ") else f"{argument!r} is not a {name.replace('_', ' ')}"
        example = ",".join(f"{getattr(usual, each):g}" for each in numbered)
        pattern = ",".join(numbered).upper()
        raise UnknownEffectError(
            name,
            f"{why}.",
            remedy=f"Give {name}=LEVEL, or {name}={pattern} in N m and {UNITS[name]}, all above 0, as in "
            f"{name}={example}, with @SECONDS for when it sets in; {name}=0 switches it off.",
        ) from None


def parse_hidden(arguments: Iterable[str], registry: Registry) -> tuple[dict[str, float | None], dict[str, float]]:
    """`["coulomb_friction", "torque_step=2@30"]` as `hidden` and `onsets` of a SimulationConfig.

    Raises UnknownEffectError.
    """
    hidden: dict[str, float | None] = {}
    onsets: dict[str, float] = {}
    for argument in arguments:
        text, late, second = argument.partition("@")
        name, separator, level = text.partition("=")
        hidden[name] = _number(name, "level", level) if separator else None
        if late:
            onsets[name] = _number(name, "time", second)
    sizes_of(hidden, registry)
    check_onsets(onsets, registry)
    return hidden, onsets


def check_onsets(onsets: Mapping[str, float], registry: Registry) -> None:
    """Raises UnknownEffectError for an effect that cannot set in during a run, or not at this time."""
    for name, second in onsets.items():
        if name not in registry.late:
            raise UnknownEffectError(
                name,
                f"{name} acts from the beginning.",
                remedy=f"These can set in later: {', '.join(sorted(registry.late))}.",
            )
        if not (math.isfinite(second) and second >= 0.0):
            raise UnknownEffectError(
                name,
                f"{name} cannot set in at {second:g} s.",
                remedy="Give seconds after the drives started, 0 or more.",
            )


def _number(name: str, what: str, text: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise UnknownEffectError(
            name, f"the {what} of {name} is {text!r}.", remedy=f"Give numbers, as in {name}=2 or {name}=2@30."
        ) from None


def sizes_of(hidden: Mapping[str, float | None], registry: Registry) -> dict[str, float]:
    """The amplitude of each effect in its own unit; those at level 0 are left out. Raises UnknownEffectError."""
    sizes = {}
    for name, given in hidden.items():
        effect, level = registry.find(name), 1.0 if given is None else given
        size = effect.size * level
        least = -math.inf if effect.signed else 0.0
        if not (math.isfinite(level) and least <= size <= effect.most):
            raise UnknownEffectError(
                name,
                f"{name} cannot have the level {level:g}.",
                remedy=f"Use a level from {least / effect.size:g} to {effect.most / effect.size:g}; "
                f"1 is {effect.size:g} {effect.unit}.",
            )
        if level != 0.0:
            sizes[name] = size
    return sizes
