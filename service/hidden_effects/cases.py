"""The cases of the benchmark: each is a virtual record with one hidden effect, two, one outside the catalogue, or none.

A case's key determines everything, including its seed, so that the same key gives the same record anywhere.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from enum import StrEnum
from itertools import product

from upright.models.effects.catalogue import CATALOGUE
from upright.simulation.monocab.hidden import HIDDEN, UNLISTED
from upright.simulation.registry import UnknownEffectError


class Kind(StrEnum):
    """Kind of a case by its hidden effects."""

    NOTHING = "nothing"
    ONE = "one"
    TWO = "two"
    UNLISTED = "unlisted"
    """An effect that the catalogue does not have."""


@dataclass(frozen=True, slots=True)
class Case:
    """One record. `size` is in multiples of the minimum detectable effect, `noise` in multiples of the data sheet's."""

    effects: tuple[str, ...]
    size: float
    noise: float
    excitation: str
    number: int
    """Number among records that differ only in their seed."""

    @property
    def kind(self) -> Kind:
        if not self.effects:
            return Kind.NOTHING
        if any(name in UNLISTED for name in self.effects):
            return Kind.UNLISTED
        return Kind.ONE if len(self.effects) == 1 else Kind.TWO

    @property
    def key(self) -> str:
        hidden = "+".join(self.effects) or "nothing"
        return f"{hidden}|size {self.size:g}|noise {self.noise:g}|{self.excitation}|{self.number}"

    def seed(self, purpose: str = "record") -> int:
        """Seed of the random numbers for `purpose`, 0 to 2^31 - 1."""
        digest = hashlib.sha256(f"{self.key}|{purpose}".encode()).digest()
        return int.from_bytes(digest[:4], "big") >> 1

    @property
    def reference(self) -> Case:
        """The case with nothing missing whose record gives the minimum detectable effects under these conditions."""
        return Case((), 0.0, self.noise, self.excitation, 0)


@dataclass(frozen=True, slots=True)
class Grid:
    """All cases of `effects` x `sizes` x `noises` x `excitations`, `seeds` records of each, numbered from `first` on.

    For every noise and excitation there are also `seeds` records with nothing missing, and as many records of two
    effects at once as there are effects. Raises UnknownEffectError for a name that the virtual vehicle does not have.
    """

    effects: tuple[str, ...] = (*HIDDEN, *UNLISTED)
    sizes: tuple[float, ...] = (1.0, 2.0, 4.0, 8.0)
    noises: tuple[float, ...] = (1.0,)
    excitations: tuple[str, ...] = ("multisine", "sweep", "square", "hold")
    seeds: int = 3
    first: int = 0

    def __post_init__(self) -> None:
        for name in self.effects:
            if name not in HIDDEN and name not in UNLISTED:
                there = ", ".join((*HIDDEN, *UNLISTED))
                message = f"there is no hidden effect {name!r}."
                raise UnknownEffectError(name, message, remedy=f"Use some of: {there}.")

    def cases(self) -> tuple[Case, ...]:
        """All cases, those with nothing missing first."""
        numbers = range(self.first, self.first + self.seeds)
        conditions = list(product(self.noises, self.excitations, numbers))
        nothing = [Case((), 0.0, noise, excitation, number) for noise, excitation, number in conditions]
        hidden = [
            Case((effect,), size, noise, excitation, number)
            for (noise, excitation, number), size, effect in product(conditions, self.sizes, self.effects)
        ]
        listed = [name for name in self.effects if name in HIDDEN]
        two = [
            Case(pair, size, noise, excitation, number)
            for (noise, excitation, number), size in product(conditions, self.sizes)
            for pair in pairs(listed, number)
        ]
        return tuple(dict.fromkeys((*nothing, *hidden, *two)))


QUICK = Grid(
    effects=("static_torque", "coulomb_friction", "quadratic_drag", "gimbal_imbalance", "test_one_sided_damping"),
    sizes=(3.0,),
    excitations=("multisine",),
    seeds=1,
)
"""A few minutes, to check that it works, not how well."""


def pairs(effects: Sequence[str], number: int) -> Iterator[tuple[str, str]]:
    """Each effect with a partner: the `number`-th one after it that the catalogue does not call confusable with it."""
    for place, effect in enumerate(effects):
        others = [*effects[place + 1 :], *effects[:place]]
        able = [other for other in others if _apart(effect, other)]
        if able:
            first, second = sorted((effect, able[number % len(able)]))
            yield first, second


def _apart(one: str, other: str) -> bool:
    first, second = CATALOGUE[one], CATALOGUE[other]
    return first.family is not second.family and other not in first.confused_with


def references(cases: Iterable[Case]) -> tuple[Case, ...]:
    """The cases that give the minimum detectable effects for the others."""
    return tuple(dict.fromkeys(case.reference for case in cases))
