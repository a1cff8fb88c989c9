"""What a method answers when it is asked what a model lacks: the same shape for the diagnosis and for the baselines."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

from estimators.disturbance_estimate import DisturbanceEstimate
from models.effect import Effect
from models.model import Model
from telemetry.recording import Recording

ADEQUATE = "adequate"
MISSING = "missing_effect"
UNKNOWN = "unknown"
INSUFFICIENT = "insufficient_data"


@dataclass(frozen=True, slots=True)
class Found:
    """One effect that was found. `parameters`: name to value and standard deviation, where they are known.
    `negligible`: it is said that it shows, and makes next to nothing of the error."""

    effect: str
    tied_with: tuple[str, ...] = ()
    parameters: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    negligible: bool = False

    @property
    def names(self) -> frozenset[str]:
        """It and those that it cannot be told from."""
        return frozenset((self.effect, *self.tied_with))


@dataclass(frozen=True, slots=True)
class Answer:
    """`found`: the best first. With the verdict `unknown` something is missing beside or instead of them.

    `repaired` is the model with the found effects and fitted values, None where the method fits none. `detectable`:
    effect to the smallest size that can be seen, in the unit of its first amplitude. `disturbance`: its
    numbers, rms and correlation_time, where the method gives some, with their standard deviations.
    """

    verdict: str
    found: tuple[Found, ...] = ()
    revised: Model | None = None
    detectable: Mapping[str, float] = field(default_factory=dict)
    disturbance: Mapping[str, tuple[float, float]] = field(default_factory=dict)

    @classmethod
    def naming(cls, *effects: str) -> Answer:
        """The answer of a method that gives names alone; adequate where it gives none."""
        return cls(MISSING if effects else ADEQUATE, tuple(map(Found, effects)))


class Method(Protocol):
    """Says what `model` lacks to explain the recordings. `support` rad: the vehicle is free where its roll is less.

    `candidates` are the effects that may be it, by default the whole catalogue.
    """

    def __call__(
        self,
        model: Model,
        recordings: Sequence[Recording],
        support: float,
        candidates: Sequence[str | Effect] | None = None,
    ) -> Answer: ...


def diagnosis(
    model: Model,
    recordings: Sequence[Recording],
    support: float,
    candidates: Sequence[str | Effect] | None = None,
) -> Answer:
    """What `upright diagnose` says, the gimbals as a part of their own."""
    from diagnosis.parts import diagnose_parts
    from vehicles import registry
    from vehicles.file import load

    actuators = registry.models_of(load("monocab")).actuators
    return of_diagnosis(diagnose_parts(model, actuators, recordings, support=support, candidates=candidates))


def of_diagnosis(found: Any) -> Answer:
    """A diagnosis.diagnose.Diagnosis as an answer."""
    findings = [
        Found(
            each.effect,
            tuple(each.tied_with),
            {
                name: (float(parameter.value), float(parameter.std))
                for name, parameter in each.parameters.items()
                if parameter.value is not None and parameter.std is not None
            },
            each.negligible,
        )
        for each in found.findings
    ]
    detectable = dict(found.minimum_detectable or {})
    return Answer(str(found.verdict), tuple(findings), found.revised, detectable, _disturbance(found.disturbance))


def _disturbance(found: Sequence[DisturbanceEstimate]) -> dict[str, tuple[float, float]]:
    """The two numbers of the first joint's, where they are estimated."""
    if not found:
        return {}
    first = found[0]
    numbers = {
        "rms": (first.std, first.std_error),
        "correlation_time": (first.correlation_time, first.correlation_time_error),
    }
    return {name: (value, std) for name, (value, std) in numbers.items() if value is not None and std is not None}
