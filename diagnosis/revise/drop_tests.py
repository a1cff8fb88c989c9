"""Backward elimination: is every effect of a model still needed? Each is left out in turn, and the rest is refitted.

An effect that was needed when it was added may become useless when a better one is added: viscous friction that
imitated dry friction goes to zero once dry friction is in the model.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import exp
from typing import Any

from upright.diagnosis.evidence import is_supported
from upright.diagnosis.prepare.ready import ready
from upright.diagnosis.revise.with_and_without import Estimated, alone, training
from upright.models.model import Model
from upright.telemetry.recording import Recording


@dataclass(frozen=True, slots=True)
class DropTest:
    """`likelihood_ratio`: twice the fall of the log-likelihood without the effect, chi-squared with `degrees` of
    freedom if there is no such effect. `bic_difference`: BIC without it less BIC with it. `t_ratio`: number of standard
    deviations by which its amplitude differs from zero."""

    effect: str
    likelihood_ratio: float
    degrees: int
    bic_difference: float
    t_ratio: float

    @property
    def odds(self) -> float:
        """Odds for the effect."""
        return exp(min(max(0.5 * self.bic_difference, -700.0), 700.0))

    @property
    def needed(self) -> bool:
        """Whether the records support it."""
        return is_supported(0.5 * self.likelihood_ratio, self.degrees, self.t_ratio)

    @property
    def verdict(self) -> str:
        return "needed" if self.needed else "can go"

    def to_json(self) -> dict[str, Any]:
        return {
            "effect": self.effect,
            "likelihood_ratio": self.likelihood_ratio,
            "degrees": self.degrees,
            "bic_difference": self.bic_difference,
            "surety": self.t_ratio,
            "verdict": self.verdict,
        }


def drop_tests(
    model: Model,
    recordings: Sequence[Recording],
    *,
    support: float | None = None,
    progress: Callable[[str, float], None] | None = None,
) -> list[DropTest]:
    """One test for every effect of `model`, those that can go first. Raises DataError and EstimationError."""
    report = progress or (lambda text, share: None)
    if not model.effects:
        return []
    count = 1.0 + len(model.effects)
    report("fitting the whole model", 0.0)
    model = ready(model, recordings)
    samples = training(model, recordings, support)
    whole = Estimated.of(alone(model, samples))
    found = []
    for place, attached in enumerate(model.effects):
        report(f"fitting without {attached.name}", (1.0 + place) / count)
        without = Estimated.of(alone(model.remove(attached.name), samples))
        found.append(
            DropTest(
                effect=attached.name,
                # With priors the likelihood alone may fall a little when an effect is added.
                likelihood_ratio=max(0.0, 2.0 * (whole.log_likelihood - without.log_likelihood)),
                degrees=len(whole.values) - len(without.values),
                bic_difference=without.bic - whole.bic,
                t_ratio=whole.t_ratio(attached.name),
            )
        )
    report("done", 1.0)
    return sorted(found, key=lambda each: each.bic_difference)
