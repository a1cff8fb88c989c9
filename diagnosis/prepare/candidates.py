"""The effects that a model may lack: those of the catalogue that it can have and for which its recordings are
sufficient.

An effect's amplitudes are zero if it is absent; its shape (a frequency, a width) is then undetermined. So each
candidate comes as one or several variants, the same amplitudes at different shapes, to be scored side by side.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product

from upright.estimators.data.segments import channels_of, optional_channels
from upright.models.attach import places_for, starts
from upright.models.effect import AttachedEffect, Effect, Role
from upright.models.effects.catalogue import CATALOGUE, find
from upright.models.model import Model
from upright.models.parts import ModelError
from upright.models.sensing import is_learned_bias
from upright.telemetry.recording import Recording

MOST_VARIANTS = 24
"""Variants of one effect, at most."""


@dataclass(frozen=True, slots=True)
class Candidate:
    """An effect as it would be in the model. `variants`: values of its shape parameters by name, at least one.

    The last `picked` of them were picked from the data, among `among` possible ones.
    """

    attached: AttachedEffect
    variants: tuple[Mapping[str, float], ...]
    picked: int = 0
    among: int = 1

    @property
    def name(self) -> str:
        return self.attached.name

    @property
    def effect(self) -> Effect:
        return self.attached.effect

    @property
    def amplitudes(self) -> tuple[str, ...]:
        """Names in the model."""
        return self.attached.amplitudes

    @property
    def shapes(self) -> tuple[str, ...]:
        """Names in the model of the parameters that are not amplitudes."""
        return tuple(p.name for p in self.attached.parameters if p.name not in self.amplitudes)


def candidates_for(
    model: Model, recordings: Sequence[Recording], effects: Iterable[str | Effect] | None = None
) -> tuple[list[Candidate], dict[str, str]]:
    """The candidates among `effects` (default: the catalogue), each at every place that can have it, and, by name, why
    others are excluded.

    Without recordings every effect that may set in later is a candidate: a filter learns a constant error, but not at
    once.
    """
    there = {attached.name for attached in model.effects}
    found: list[Candidate] = []
    left_out: dict[str, str] = {}
    for each in effects if effects is not None else CATALOGUE:
        effect = find(each) if isinstance(each, str) else each
        try:
            places = places_for(model, effect)
        except ModelError as error:
            left_out[effect.name] = str(error)
            continue
        for place in places:
            name = effect.name if place == places[0] else f"{effect.name}@{place}"
            if name in there:
                continue
            with_it = model.add(effect, place)
            lacking = [
                channel
                for channel in set(channels_of(with_it)) - optional_channels(with_it)
                if any(channel not in each.values for each in recordings) and channel not in channels_of(model)
            ]
            if lacking:
                left_out[name] = f"needs channel {', '.join(lacking)}, which is not recorded"
                continue
            if recordings and any(s.name == place and is_learned_bias(s, effect) for s in model.sensors):
                left_out[name] = f"the filter of {place} has learned it before the record begins"
                continue
            attached = with_it.effects[-1]
            found.append(Candidate(attached, _variants(model, attached)))
    return found, left_out


def candidate_of(model: Model, attached: AttachedEffect) -> Candidate:
    """`attached`, the last effect of a model that was `model` before, with the shapes it names."""
    names = [p.name for p in attached.effect.parameters if not p.amplitude]
    values = product(*(starts(model, attached, name) for name in names))
    qualified = [attached.qualified(name) for name in names]
    return Candidate(attached, tuple(dict(zip(qualified, each, strict=True)) for each in values))


def at_frequencies(candidates: Sequence[Candidate], frequencies: Sequence[float], among: int) -> list[Candidate]:
    """`candidates`, those whose shape is a frequency (Hz) with further variants at `frequencies`.

    `among` is the number from which these were picked.
    """
    found = []
    for each in candidates:
        lines = each.attached.of_role(Role.FREQUENCY)
        shapes = [p for p in each.attached.parameters if p.name in lines]
        more = [
            {**each.variants[0], shape.name: value}
            for shape in shapes
            for value in frequencies
            if shape.lower < value < shape.upper
        ]
        found.append(replace(each, variants=(*each.variants, *more), picked=len(more), among=among))
    return found


def _variants(model: Model, attached: AttachedEffect) -> tuple[Mapping[str, float], ...]:
    names = [p.name for p in attached.effect.parameters if not p.amplitude]
    values = [starts(model, attached, name) for name in names]
    first = tuple(each[0] for each in values)
    # All combinations if these are few, else one parameter is varied at a time.
    combinations: list[tuple[float, ...]] = list(product(*values))
    if len(combinations) > MOST_VARIANTS:
        combinations = [first]
        for place, each in enumerate(values):
            combinations += [(*first[:place], value, *first[place + 1 :]) for value in each[1:]]
    return tuple(dict(zip(map(attached.qualified, names), each, strict=True)) for each in combinations)
