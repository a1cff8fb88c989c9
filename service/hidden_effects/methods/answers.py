"""The answer of a method to the question which effect a model lacks, common to the diagnosis and the baselines."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

from upright.estimators.disturbance_estimate import DisturbanceEstimate
from upright.models.effect import Effect
from upright.models.model import Model
from upright.telemetry.recording import Recording

ADEQUATE = "adequate"
MISSING = "missing_effect"
UNKNOWN = "unknown"
INSUFFICIENT = "insufficient_data"


@dataclass(frozen=True, slots=True)
class Found:
    """One effect that was found. `parameters`: values and standard deviations by name, if they are known.
    `negligible`: the effect is significant, but its share of the error is negligible."""

    effect: str
    tied_with: tuple[str, ...] = ()
    parameters: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    negligible: bool = False

    @property
    def names(self) -> frozenset[str]:
        """The effect and those that it is tied with."""
        return frozenset((self.effect, *self.tied_with))


@dataclass(frozen=True, slots=True)
class Answer:
    """`found`: the best first. With the verdict `unknown` something else is missing, beside or instead of them.

    `revised` is the model with the found effects and fitted values, None if the method fits none. `detectable`: the
    minimum detectable size by effect, in the unit of its first amplitude. `disturbance`: rms and correlation_time with
    their standard deviations, if the method estimates them.
    """

    verdict: str
    found: tuple[Found, ...] = ()
    revised: Model | None = None
    detectable: Mapping[str, float] = field(default_factory=dict)
    disturbance: Mapping[str, tuple[float, float]] = field(default_factory=dict)

    @classmethod
    def naming(cls, *effects: str) -> Answer:
        """The answer of a method that only gives names; adequate if it gives none."""
        return cls(MISSING if effects else ADEQUATE, tuple(map(Found, effects)))


class Method(Protocol):
    """Finds what `model` lacks to explain the recordings. `support` rad: the vehicle is free if its roll is smaller.

    `candidates` are the effects to consider, by default the whole catalogue.
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
    """The answer of `upright diagnose`, with the gimbals as a separate part."""
    from upright.diagnosis.parts import diagnose_parts
    from upright.vehicles import registry
    from upright.vehicles.file import load

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
    """RMS and correlation time at the first joint, if they are estimated."""
    if not found:
        return {}
    first = found[0]
    numbers = {
        "rms": (first.std, first.std_error),
        "correlation_time": (first.correlation_time, first.correlation_time_error),
    }
    return {name: (value, std) for name, (value, std) in numbers.items() if value is not None and std is not None}
