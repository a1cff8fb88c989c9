"""The result of a diagnosis: the verdict, the missing effects, and how they were found."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any

from upright.diagnosis.fits.refit import FullFit
from upright.diagnosis.fits.stated_values import Contradiction
from upright.diagnosis.gates import HeldOut, Round
from upright.diagnosis.lack_of_fit.adequacy import Adequacy
from upright.diagnosis.lack_of_fit.events import Event
from upright.diagnosis.prediction.limit import PredictionLimit
from upright.diagnosis.prediction.relevance import Relevance
from upright.diagnosis.score.score_test import ScoreTest
from upright.estimators.contract import ParameterEstimate
from upright.estimators.disturbance_estimate import DisturbanceEstimate
from upright.estimators.fit.random.sensor_errors import InputError, SensorError
from upright.models.effect import Effect
from upright.models.model import Model


class Verdict(StrEnum):
    """What a diagnosis ends with."""

    ADEQUATE = "adequate"
    MISSING_EFFECT = "missing_effect"
    UNKNOWN = "unknown"
    INSUFFICIENT_DATA = "insufficient_data"


@dataclass(frozen=True, slots=True)
class MadeOf:
    """A finding expressed as the two effects that it combines.

    `parameters` of both, by name; `log_likelihood_gain` of the model with the two over that with the one.
    """

    parameters: Mapping[str, ParameterEstimate]
    log_likelihood_gain: float


@dataclass(frozen=True, slots=True)
class Finding:
    """An effect that the model lacks. If there are several, each is estimated with the others in the model.

    `probability` among all candidates and none; `p_value` corrected for all candidates; `log_likelihood_gain` over the
    model before; `held_out`: the result on held-out data, None if there is none; `odds` of every effect that got a full
    fit, relative to this one, and their log-likelihood `gains`, as shares of this one's; `score_test`: the one in which
    it was found. `made_of`, if it combines two effects; `relevance`: the share of the errors that it causes.
    """

    effect: str
    family: str
    parameters: Mapping[str, ParameterEstimate]
    probability: float
    p_value: float
    tied_with: tuple[str, ...]
    explanation: str
    log_likelihood_gain: float
    held_out: HeldOut | None
    odds: Mapping[str, float]
    gains: Mapping[str, float] = field(default_factory=dict)
    score_test: ScoreTest | None = None
    made_of: MadeOf | None = None
    relevance: Relevance | None = None

    @property
    def lead(self) -> float:
        """By how much its log-likelihood ratio exceeds that of the next effect that passed all checks, or of none,
        nats; 0 if it is tied."""
        others = [share for name, share in self.gains.items() if name != self.effect]
        return 0.0 if self.tied_with else self.log_likelihood_gain * (1.0 - max(others, default=0.0))

    @property
    def negligible(self) -> bool:
        """Whether it causes no error that matters, as far as that is known."""
        return self.relevance is not None and self.relevance.negligible

    @property
    def held_out_error_closed_percent(self) -> float | None:
        """Of the error energy on held-out data that exceeds the sensors', the share that the effect removes."""
        return self.held_out.closed_percent if self.held_out else None

    @property
    def definition(self) -> Effect:
        """The effect, from the score test in which it was found."""
        assert self.score_test is not None
        return self.score_test.score(self.effect).candidate.effect

    def to_json(self) -> dict[str, Any]:
        """One of `findings` in `diagnose --json`."""
        return {
            "effect": self.effect,
            "family": self.family,
            "parameters": _to_json(self.parameters),
            "probability": self.probability,
            "p_value": self.p_value,
            "held_out_error_closed_percent": self.held_out_error_closed_percent,
            "tied_with": list(self.tied_with),
            "made_of": {
                "parameters": _to_json(self.made_of.parameters),
                "log_likelihood_gain": self.made_of.log_likelihood_gain,
            }
            if self.made_of
            else None,
            "relevance": self.relevance.to_json() if self.relevance else None,
            "explanation": self.explanation,
        }


def _to_json(parameters: Mapping[str, ParameterEstimate]) -> dict[str, Any]:
    return {
        name: {"value": each.value, "std": each.std, "unit": each.unit, "identifiable": each.identifiable}
        for name, each in parameters.items()
    }


@dataclass(frozen=True, slots=True)
class Diagnosis:
    """The verdict with its `reason`, the findings, and `revised`, the model with them; `score_tests` of the model alone
    and after each effect that was added.

    `steps`: the fit of the model alone, then the fit after each of `findings`. `disturbance`: the random force at each
    joint in the last of these fits, which no effect explains, and `prediction_limit` the error that it causes;
    `events`: times at which the disturbance changes, excluded from all else. `sensor_errors`: errors of sensors other
    than the white noise of outputs. `untried`: what was left for lack of time. `parts`: the diagnoses of a vehicle and
    of its actuators that this one combines (diagnosis.parts), none if it is of one model. `rounds`: what was decided
    about each effect that was fitted. `contradicted`: values that the model states and that the recordings contradict.
    """

    verdict: Verdict
    reason: str
    findings: tuple[Finding, ...] = ()
    minimum_detectable: Mapping[str, float] | None = None
    suggested_experiment: Mapping[str, Any] | None = None
    innovation_ratio_before: float | None = None
    innovation_ratio_after: float | None = None
    revised: Model | None = None
    left_out: Mapping[str, str] | None = None
    score_tests: tuple[ScoreTest, ...] = ()
    steps: tuple[FullFit, ...] = ()
    unexplained: Adequacy | None = None
    disturbance: tuple[DisturbanceEstimate, ...] = ()
    sensor_errors: tuple[SensorError | InputError, ...] = ()
    prediction_limit: PredictionLimit | None = None
    untried: tuple[str, ...] = ()
    events: tuple[Event, ...] = ()
    parts: tuple[Diagnosis, ...] = ()
    rounds: tuple[Round, ...] = ()
    contradicted: tuple[Contradiction, ...] = ()

    @property
    def adequate(self) -> bool:
        return self.verdict is Verdict.ADEQUATE

    def to_json(self) -> dict[str, Any]:
        """`diagnose --json`."""
        return {
            "adequate": self.adequate,
            "verdict": self.verdict.value,
            "reason": self.reason,
            "findings": [finding.to_json() for finding in self.findings],
            "minimum_detectable": dict(self.minimum_detectable or {}),
            "suggested_experiment": dict(self.suggested_experiment) if self.suggested_experiment else None,
            "innovation_ratio_before": self.innovation_ratio_before,
            "innovation_ratio_after": self.innovation_ratio_after,
            "disturbance": {each.joint: each.to_json() for each in self.disturbance},
            "sensor_errors": {each.channel: each.to_json() for each in self.sensor_errors},
            "contradicted": [each.to_json() for each in self.contradicted],
            "untried": list(self.untried),
            "events": [each.to_json() for each in self.events],
            "prediction_limit": self.prediction_limit.to_json() if self.prediction_limit else None,
            "not_candidates": dict(self.left_out or {}),
        }
