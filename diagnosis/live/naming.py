"""From the products of a live diagnosis to names: which effects stand out, since when, and what they are tied with.

An effect is named when its odds against none (`diagnosis.live.odds`) exceed what chance reaches if nothing is missing.
Every effect that these odds do not distinguish from it yet is named with it: soon after its onset these may be several,
later fewer. If nothing in the catalogue explains the data, no name is given.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from upright.diagnosis.gates import confusable
from upright.diagnosis.live.odds import Weighed, weigh
from upright.diagnosis.live.onset import BEGINNING, Amplitudes, Onset
from upright.diagnosis.live.products import Products
from upright.diagnosis.prepare.candidates import Candidate
from upright.estimators.disturbance_estimate import DisturbanceEstimate
from upright.estimators.fit.problem import Problem
from upright.estimators.numbers import with_error
from upright.estimators.recursive.predictor import Seen
from upright.estimators.tails import normal_isf
from upright.models.effect import AttachedEffect, Effect
from upright.models.effects.catalogue import CATALOGUE, find
from upright.models.parts import Parameter

Array = NDArray[np.float64]

LEVEL = 0.01
"""Probability of naming an effect in the first minute, if nothing is missing; as much for each e-fold of time later."""
LOOKS = 2.0
"""Tests of one effect in a minute that are as good as independent.

Counted in 51 minutes of multisine with nothing missing: in a tenth of them the best of 21 effects has odds of 440, in
a twentieth 800."""
DETECTABLE = float(2.0 * normal_isf(0.01))
"""Standard errors of an amplitude that is found with 99 % probability at 1 % false alarms."""
EXPLAINED = 0.1
"""Share of the excess energy since its onset that an effect must explain to be named."""
SHORTEST = 2
"""s that an effect must have acted to be named. At its onset an effect resembles many others."""
KEPT = 32
"""s back within which an onset is searched for, except for one that was found."""
MOST = 3
"""Effects that are named at once."""
FURTHER = 0.05
"""Share of the statistics of those named that a further effect has to reach: in one shape and with one linear step, a
formula fits less well than one that is refitted."""
NEAR = 0.5
"""Share of the logarithm of odds that a name needs, from which on effects are tested every second instead of every
other one: an effect that sets in reaches it in half the time to its name."""
BEGUN = {each.onset_of: each.name for each in CATALOGUE.values() if each.onset_of}
"""Name of an effect that was not there from the beginning."""


@dataclass(frozen=True, slots=True)
class LiveFinding:
    """An effect that shows. `since` s from the first cycle, 0 if it was there from the beginning."""

    effect: str
    family: str
    sizes: Mapping[str, tuple[float, float, str]]
    """Parameter to value, standard deviation and unit."""
    since: float
    probability: float
    p_value: float
    tied_with: tuple[str, ...]
    explanation: str

    def to_json(self) -> dict[str, Any]:
        """One of `findings` as in `diagnose --json`, with `since`."""
        return {
            "effect": self.effect,
            "family": self.family,
            "parameters": {
                name: {"value": value, "std": std, "unit": unit, "identifiable": True}
                for name, (value, std, unit) in self.sizes.items()
            },
            "probability": self.probability,
            "p_value": self.p_value,
            "held_out_error_closed_percent": None,
            "tied_with": list(self.tied_with),
            "explanation": self.explanation,
            "since": self.since,
        }


@dataclass(frozen=True, slots=True)
class LiveResult:
    """What is known now. `seconds`: free motion that it is based on. `detectable`: minimum detectable effect, in the
    first amplitude of each. `disturbance`: the random force at each joint, which no effect explains."""

    findings: tuple[LiveFinding, ...]
    detectable: Mapping[str, float]
    seconds: int
    reason: str = ""
    disturbance: tuple[DisturbanceEstimate, ...] = ()

    @property
    def verdict(self) -> str:
        if self.reason:
            return "insufficient_data"
        return "missing_effect" if self.findings else "adequate"

    def to_json(self) -> dict[str, Any]:
        """As `diagnose --json`; nothing is refitted or held out while the vehicle runs, so these are null."""
        return {
            "adequate": self.verdict == "adequate",
            "verdict": self.verdict,
            "reason": self.reason,
            "findings": [each.to_json() for each in self.findings],
            "minimum_detectable": dict(self.detectable),
            "suggested_experiment": None,
            "innovation_ratio_before": None,
            "innovation_ratio_after": None,
            "disturbance": {each.joint: each.to_json() for each in self.disturbance},
            "seconds": self.seconds,
        }


TOO_LITTLE = LiveResult((), {}, 0, "too little free motion so far")


class Gathered:
    """The data that have come in so far, and the result from them, renewed every second or two."""

    def __init__(
        self, entries: Sequence[Entry], order: NDArray[np.int64], products: Products, about: Array, *, whole: bool
    ) -> None:
        self._whole = whole
        self._entries = {each.amplitudes.name: each for each in entries}
        self.about = about
        """The point from which the unknowns of the recursion are counted."""
        self.order = order
        """The columns of the recursion in the order that `Products` needs; those of candidates follow them."""
        self.products = products
        self._began: list[float] = []
        self._filled = 0.0
        self._onsets: list[int] = []
        self._near = True

    @classmethod
    def of(cls, base: Problem, candidates: Sequence[Candidate], seen: Seen, *, whole: bool) -> Gathered:
        """Columns in the order that `Products` needs: nuisances, effects that the model has, candidates. `whole`: it
        begins where the run does."""
        free = [base.model.parameters[place].name for place in base.free]
        there = [each for each in base.model.effects if set(each.amplitudes) <= set(free)]
        theirs = [free.index(name) for each in there for name in each.amplitudes]
        nuisances = [place for place in range(len(seen.prior)) if place not in theirs]
        entries, place = [], len(nuisances)
        for effect, scales in (
            *((each, tuple(base.scale[[free.index(name) for name in each.amplitudes]])) for each in there),
            *((each.attached, (1.0,) * len(each.amplitudes)) for each in candidates),
        ):
            entries.append(Entry.of(effect, tuple(range(place, place + len(scales))), tuple(map(float, scales))))
            place += len(scales)
        order = np.array([*nuisances, *theirs])
        # Nuisances count from their present values, about which they are linear; the model's own effects from zero.
        about = np.zeros(len(seen.prior))
        about[: len(seen.z)] = seen.z
        about[theirs] = 0.0
        products = Products(seen.prior[nuisances], -about[nuisances], place + 1, KEPT)
        return cls(entries, order, products, about[: len(seen.z)], whole=whole)

    def completes(self, further: float, part: float) -> bool:
        """Whether so many `further` s complete a second, in parts that last `part` s."""
        return self._filled + further >= 1.0 - 0.5 * part

    def add(self, columns: Array, parts: Iterable[tuple[slice, float, float]]) -> bool:
        """Further numbers (n, m): `parts` are those that belong together, when they began and how long they last, in s.

        Returns whether they complete a second.
        """
        first = 0
        for rows, begin, span in parts:
            if self._filled == 0.0:
                self._began.append(begin)
            full = self.completes(span, span)
            self._filled += span
            if full:
                self._filled = 0.0
                self.products.add(columns[first : rows.stop])
                self.products.end_second(self._onsets)
                first = rows.stop
        self.products.add(columns[first:])
        return first > 0

    def forget(self, effect: str) -> None:
        """Forget what was gathered of this effect, whose shape is another from now on."""
        if effect in self._entries:
            self.products.forget(self._entries[effect].amplitudes.columns)

    def is_due(self) -> bool:
        """Whether the last complete second is evaluated: every one while an effect is near a name, else every other."""
        return self._near or self.products.seconds % 2 == 0

    def look(self, shapes: Mapping[str, tuple[float, float, str]], tries: Mapping[str, int]) -> LiveResult:
        """Name the effects that stand out, the strongest first, each with those before it taken as given.

        `shapes`: values, standard deviations and units of parameters that were picked from the data; `tries`, by
        effect: the number of values they were picked from.
        """
        if self.products.seconds <= SHORTEST:
            return TOO_LITTLE
        amplitudes = [entry.amplitudes for entry in self._entries.values()]
        minutes = max(1.0, self.products.seconds / 60.0)
        looks = LOOKS * len(amplitudes) * minutes
        least = math.log(looks / LEVEL)
        named: list[Onset] = []
        findings: list[LiveFinding] = []
        detectable: dict[str, float] = {}
        reason = ""
        while len(named) < MOST:
            found, errors = weigh(self.products, amplitudes, named, tries, least if named else NEAR * least)
            if not named:
                self._near = bool(found)
                detectable = {name: DETECTABLE * error * self._entries[name].scale[0] for name, error in errors.items()}
            if not found or found[0].log_odds < least or self._is_young(found[0]):
                break
            best = simplest(found)
            if best.explained < EXPLAINED:
                reason = (
                    f"since {self._began[best.onset.second]:.0f} s something acts that no known effect explains yet"
                )
                break  # never beside another name: `explained` is 1 then
            if best.onset.statistic < self._needed(best.onset, named):
                break
            findings.append(self._finding(best, found, looks, shapes))
            named.append(best.onset)
        self._onsets = [each.second for each in named if each.second != BEGINNING]
        return LiveResult(tuple(findings), detectable, self.products.seconds, reason)

    def _is_young(self, weighed: Weighed) -> bool:
        second = weighed.onset.second
        return second != BEGINNING and self.products.seconds - second < SHORTEST

    def _needed(self, onset: Onset, named: Sequence[Onset]) -> float:
        """The statistic that a further effect has to reach: no formula and no onset is exact."""
        effect = self._entries[onset.effect.name].effect

        def left(other: Effect) -> float:
            """Share of what `other` explains that may be confused with the effect."""
            return max(FURTHER, other.formula_error) if confusable(effect, other) else FURTHER

        return sum(left(self._entries[each.effect.name].effect) * each.statistic for each in named)

    def _finding(
        self,
        named: Weighed,
        found: Sequence[Weighed],
        looks: float,
        shapes: Mapping[str, tuple[float, float, str]],
    ) -> LiveFinding:
        best, highest = named.onset, found[0].log_odds
        entry = self._entries[best.effect.name]
        tied = tuple(self._called(each.onset) for each in found if each is not named and each.tied)
        none = math.exp(-highest)
        likely = [math.exp(each.log_odds - highest) for each in found]
        sizes = {
            parameter.name: (float(size) * scale, float(std) * scale, parameter.unit)
            for parameter, size, std, scale in zip(
                entry.parameters, best.sizes, best.standard_errors, entry.scale, strict=True
            )
        }
        sizes |= {name: shape for name, shape in shapes.items() if name.startswith(f"{best.effect.name}.")}
        since = 0.0 if self._from_the_beginning(best) else self._began[best.second]
        called = self._called(best)
        kind = called.partition("@")[0]
        effect = find(kind) if kind in CATALOGUE else entry.effect
        return LiveFinding(
            effect=called,
            family=effect.family.value,
            sizes=sizes,
            since=since,
            probability=math.exp(named.log_odds - highest) / (sum(likely) + none),
            p_value=min(1.0, looks * math.exp(-named.log_odds)),
            tied_with=tied,
            explanation=_explain(called, effect, sizes, since, tied),
        )

    def _from_the_beginning(self, onset: Onset) -> bool:
        """The amplitudes in the second before an onset are free: an onset in the second one says nothing about the time
        before, unless something sudden came there, in which the predictor lost the vehicle."""
        return onset.second == BEGINNING or (self._whole and onset.second == BEGINNING + 1)

    def _called(self, onset: Onset) -> str:
        """The name in a model, EFFECT or EFFECT@PLACE."""
        effect, at, place = onset.effect.name.partition("@")
        return onset.effect.name if self._from_the_beginning(onset) else BEGUN.get(effect, effect) + at + place


@dataclass(frozen=True, slots=True)
class Entry:
    """An effect and its columns. `scale` (k,) is the amplitude per unit of each column."""

    effect: Effect
    amplitudes: Amplitudes
    parameters: tuple[Parameter, ...]
    scale: tuple[float, ...]

    @classmethod
    def of(cls, attached_effect: AttachedEffect, columns: tuple[int, ...], scale: tuple[float, ...]) -> Entry:
        parameters = tuple(p for p in attached_effect.parameters if p.name in attached_effect.amplitudes)
        lower = tuple(p.lower / each for p, each in zip(parameters, scale, strict=True))
        upper = tuple(p.upper / each for p, each in zip(parameters, scale, strict=True))
        effect = attached_effect.effect
        amplitudes = Amplitudes(attached_effect.name, columns, lower, upper, effect.sets_in, effect.formula_error)
        return cls(effect, amplitudes, parameters, scale)


def simplest(found: Sequence[Weighed]) -> Weighed:
    """The effect with the fewest amplitudes among those that are as likely as the first, except for formula errors."""
    error = found[0].onset.effect.formula_error
    near = [
        each
        for each in found
        if each.log_odds >= (1.0 - max(error, each.onset.effect.formula_error)) * found[0].log_odds
    ]
    return min(near, key=lambda each: len(each.onset.effect.columns))


def _explain(
    called: str, effect: Effect, sizes: Mapping[str, tuple[float, float, str]], since: float, tied: Sequence[str]
) -> str:
    values = ", ".join(
        f"{name.split('.')[-1]} = {with_error(value, std, unit)}" for name, (value, std, unit) in sizes.items()
    )
    when = f", since {since:.0f} s" if since else ""
    text = f"{called}: {effect.title} ({effect.equation}); {values}{when}."
    if tied:
        text += f" Tied with {', '.join(tied)}. {effect.separated_by}"
    return text + " This is a first answer, from one linear step: upright diagnose RECORDING refits it."
