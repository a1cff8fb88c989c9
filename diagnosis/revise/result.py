"""The result of adding an effect to a model: errors before and after, the error budget, and what it proves."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from math import exp, sqrt
from typing import Any

from upright.diagnosis.evidence import ODDS, by_chance, is_supported, likelier
from upright.estimators.disturbance_estimate import DisturbanceEstimate
from upright.models.model import Model

CLEARLY = 3.0
"""Standard errors above which a difference of held-out errors counts."""

Errors = Mapping[str, tuple[float, ...]]
"""Channel to RMS error at each horizon, in the channel's unit."""


@dataclass(frozen=True, slots=True)
class FittedParameter:
    """`status` and `reason` as in an estimate; value and std are given even if it is not known well enough."""

    value: float
    std: float
    unit: str
    status: str
    reason: str = ""


@dataclass(frozen=True, slots=True)
class Side:
    """The model without (before) or with (after) the effect, fitted.

    `training` and `held_out` are RMS errors; `innovation_ratio` is the innovations' energy over that of a correct
    model; `disturbance` is the disturbance that this model leaves at each joint.
    """

    log_likelihood: float
    bic: float
    parameters: Mapping[str, FittedParameter]
    training: Errors
    held_out: Errors
    innovation_ratio: float
    disturbance: tuple[DisturbanceEstimate, ...] = ()


@dataclass(frozen=True, slots=True)
class Budget:
    """Shares of the held-out error energy at the last horizon, before the effect was added; they sum to 1.

    `before` and `after` are that energy over a correct model's, the mean of all channels.
    """

    sensors: float
    effect: float
    unexplained: float
    before: float
    after: float

    @classmethod
    def of(cls, before: float, after: float) -> Budget:
        """From the two energies. An effect that increases the error has no share; the rest is as before."""
        left = min(before, after)
        sensors = min(1.0, left)
        return cls(sensors / before, (before - left) / before, (left - sensors) / before, before, after)

    @property
    def fall(self) -> float:
        """Share by which the RMS error falls; negative if it rises."""
        return 1.0 - sqrt(self.after / self.before)

    @property
    def closed_percent(self) -> float | None:
        """Percentage removed of the RMS error in excess of a correct model's; None if there is no excess."""
        excess = sqrt(self.before) - 1.0
        return 100.0 * (sqrt(self.before) - sqrt(self.after)) / excess if excess > 0.0 else None


@dataclass(frozen=True, slots=True)
class Moved:
    """A parameter known before (CAD), and the deviation of each fit from that, in standard deviations of the prior."""

    cad: float
    std: float
    before: float
    after: float

    @property
    def back(self) -> bool:
        """Whether it moved back towards its CAD value with the effect."""
        return abs(self.after) < abs(self.before)


@dataclass(frozen=True, slots=True)
class Neighbour:
    """Another effect instead of the one that was added. `bic_difference`: its BIC less that of the added one.

    `fall`: share by which the held-out RMS error falls with it. `t_ratio`: number of standard errors by which its
    held-out error energy is below that of the added one. `correlation` of the two score directions, 0 to 1, None if
    this record shows nothing of one of them.
    """

    effect: str
    bic_difference: float
    fall: float
    t_ratio: float
    correlation: float | None
    separated_by: str

    @property
    def odds(self) -> float:
        """Odds for it, against the effect that was added."""
        return exp(min(max(-0.5 * self.bic_difference, -700.0), 700.0))

    @property
    def better(self) -> bool:
        """Whether both the odds and the held-out data are clearly for it."""
        return likelier(-0.5 * self.bic_difference) and self.t_ratio > CLEARLY

    @property
    def tied(self) -> bool:
        """Whether it explains as much: the odds are not against it, or are for it without a gain on held-out data."""
        return not self.better and self.odds * ODDS >= 1.0


@dataclass(frozen=True, slots=True)
class Revision:
    """The result of `diagnosis.revise.revision.revise`. `model` is the one with the effect and all values fitted.

    `recordings` and `held_out` say in words which data were fitted and held out. `horizons`: s ahead at which errors
    are given. `floor_training` and `floor_held_out` are the errors of a correct model from the sensors alone. `moved`
    are the parameters known before, by name. `t_ratio`: number of standard deviations by which the effect's amplitude
    differs from zero.
    """

    model: Model
    effect: str
    title: str
    at: str
    recordings: tuple[str, ...]
    held_out: tuple[str, ...]
    horizons: tuple[float, ...]
    before: Side
    after: Side
    floor_training: Errors
    floor_held_out: Errors
    budget: Budget
    moved: Mapping[str, Moved]
    neighbours: tuple[Neighbour, ...]
    separated_by: str
    uses_time: bool
    t_ratio: float

    @property
    def odds(self) -> float:
        """Odds for the model with the effect, against the one without, by BIC."""
        return exp(min(max(0.5 * (self.before.bic - self.after.bic), -700.0), 700.0))

    @property
    def needed(self) -> bool:
        """Whether these records support the effect at all."""
        return is_supported(*self._log_ratio, self.t_ratio)

    @property
    def p_value(self) -> float:
        """Probability that chance alone raises the likelihood as much."""
        return by_chance(*self._log_ratio)

    @property
    def _log_ratio(self) -> tuple[float, int]:
        """Rise of the log-likelihood, and the number of further parameters."""
        log_ratio = self.after.log_likelihood - self.before.log_likelihood
        return log_ratio, len(self.after.parameters) - len(self.before.parameters)

    @property
    def units(self) -> dict[str, str]:
        """Units of the channels."""
        return {output.name: output.unit for output in self.model.outputs}

    def to_json(self) -> dict[str, Any]:
        """As JSON-ready values."""
        return {
            "effect": self.effect,
            "at": self.at,
            "recordings": list(self.recordings),
            "held_out": list(self.held_out),
            "horizons": list(self.horizons),
            "before": _side(self.before),
            "after": _side(self.after),
            "floor": {"training": _errors(self.floor_training), "held_out": _errors(self.floor_held_out)},
            "odds": self.odds,
            "p_value": self.p_value,
            "surety": self.t_ratio,
            "needed": self.needed,
            "budget": {
                "sensors": self.budget.sensors,
                "effect": self.budget.effect,
                "unexplained": self.budget.unexplained,
            },
            "held_out_error_closed_percent": self.budget.closed_percent,
            "held_out_error_fall_percent": 100.0 * self.budget.fall,
            "moved": {
                name: {"cad": each.cad, "std": each.std, "before": each.before, "after": each.after, "back": each.back}
                for name, each in self.moved.items()
            },
            "neighbours": [
                {
                    "effect": each.effect,
                    "bic_difference": each.bic_difference,
                    "odds": each.odds,
                    "held_out_error_fall_percent": 100.0 * each.fall,
                    "correlation": each.correlation,
                    "surety": each.t_ratio,
                    "tied": each.tied,
                    "better": each.better,
                    "separated_by": each.separated_by,
                }
                for each in self.neighbours
            ],
        }


def _errors(errors: Errors) -> dict[str, list[float]]:
    return {channel: list(each) for channel, each in errors.items()}


def _side(side: Side) -> dict[str, Any]:
    return {
        "log_likelihood": side.log_likelihood,
        "bic": side.bic,
        "parameters": {
            name: {"value": p.value, "std": p.std, "unit": p.unit, "status": p.status, "reason": p.reason}
            for name, p in side.parameters.items()
        },
        "training": _errors(side.training),
        "held_out": _errors(side.held_out),
        "innovation_ratio": side.innovation_ratio,
        "disturbance": {each.joint: each.to_json() for each in side.disturbance},
    }
