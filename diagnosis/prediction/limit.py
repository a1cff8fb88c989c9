"""How much a disturbance limits predictions: the best possible prediction of a record, with it and without it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from upright.diagnosis.prediction.ahead import sensor_floors
from upright.estimators.contract import EstimationError
from upright.estimators.data.time_scale import horizon
from upright.estimators.fit.maximum_likelihood import Fit


@dataclass(frozen=True, slots=True)
class PredictionLimit:
    """The RMS error, by channel in its unit, of the best possible prediction `horizon` s ahead: with the disturbance,
    and without it, from the sensors' noise alone."""

    horizon: float
    disturbed: Mapping[str, float]
    undisturbed: Mapping[str, float]

    def to_json(self) -> dict[str, Any]:
        """JSON-ready."""
        return {"horizon": self.horizon, "rmse": dict(self.disturbed), "undisturbed_rmse": dict(self.undisturbed)}


def prediction_limit(fitted: Fit) -> PredictionLimit | None:
    """The limit of the predictor `fitted`; None if the record is too short, or no joint has a disturbance."""
    task = fitted.problem
    if not any(state.correlation_time for state in task.model.base_states):
        return None
    ahead = horizon(task.model, task.segments)
    try:
        with_it, without = (sensor_floors(fitted, (ahead,), disturbed=each)[0].tolist() for each in (True, False))
    except EstimationError:
        return None
    channels = task.kernel.outputs
    return PredictionLimit(ahead, dict(zip(channels, with_it, strict=True)), dict(zip(channels, without, strict=True)))
