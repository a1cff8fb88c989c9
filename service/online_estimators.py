"""Which estimators run along with a vehicle of a kind, live in the observer and in a replay."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from estimators import torque_balance
from estimators.contract import Estimator
from telemetry.samples import Frame


def online_estimators(
    kind: str, parameters: Mapping[str, float], deviations: Mapping[str, float], support: float
) -> list[Estimator]:
    """The estimators of a vehicle `kind`, the preferred one last; empty for a kind that has none.

    `parameters` are the CAD values, `deviations` their standard deviations, `support` rad the roll angle on a support.
    Raises EstimationError where a parameter is missing.
    """
    if kind != "monocab":
        return []
    return [
        torque_balance.make(parameters, support, method=method, deviations=deviations)
        for method in (torque_balance.Method.PLAIN, torque_balance.Method.INSTRUMENTAL)
    ]


class EstimatorBank:
    """Several estimators over the same cycles. One that fails is left out from there on, its failure its result."""

    def __init__(self, estimators: Sequence[Estimator]) -> None:
        self._estimators = tuple(estimators)
        self._failed: dict[str, dict[str, Any]] = {}

    def reset(self) -> None:
        """Forget all cycles, and the failures with them."""
        self._failed.clear()
        for estimator in self._estimators:
            estimator.reset()

    def update(self, frames: Iterable[Frame]) -> None:
        """Take control cycles."""
        frames = list(frames)
        for estimator in self._estimators:
            if estimator.method in self._failed:
                continue
            try:
                for frame in frames:
                    estimator.update(frame)
            except (ArithmeticError, ValueError) as error:
                self._fail(estimator, error)

    def results(self) -> dict[str, Any]:
        """Method to result, JSON-ready, as in `upright identify --json`."""
        results: dict[str, Any] = {}
        for estimator in self._estimators:
            if estimator.method not in self._failed:
                try:
                    results[estimator.method] = estimator.result().to_json()
                    continue
                except (ArithmeticError, ValueError) as error:
                    self._fail(estimator, error)
            results[estimator.method] = self._failed[estimator.method]
        return results

    def _fail(self, estimator: Estimator, error: Exception) -> None:
        self._failed[estimator.method] = {
            "parameters": {},
            "status": "failed",
            "reason": f"{type(error).__name__}: {error}",
        }
