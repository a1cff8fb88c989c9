"""Which estimators run along with a vehicle of a kind, live in the observer and in a replay.

The recursion on a compiled model is made late: on the first start on a computer its model is compiled for some seconds,
and neither the recording nor the other estimators wait for that. Its cycles do: they are kept until it joins, so that
it gives the same numbers as if it had been there from the beginning.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from typing import Any

from estimators import torque_balance
from estimators.contract import Estimator
from telemetry.samples import Frame

STARTING = {
    "parameters": {},
    "status": "starting",
    "reason": "its model is being compiled, once on a computer; the cycles so far are kept for it",
}


def online_estimators(
    kind: str, parameters: Mapping[str, float], deviations: Mapping[str, float], support: float
) -> EstimatorBank:
    """The estimators of a vehicle `kind`, the preferred one last; none for a kind that has none.

    `parameters` are the CAD values, `deviations` their standard deviations, `support` rad the roll angle on a support.
    Raises EstimationError where a parameter is missing.
    """
    if kind != "monocab":
        return EstimatorBank(())
    regressions = [
        torque_balance.make(parameters, support, method=method, deviations=deviations)
        for method in (torque_balance.Method.PLAIN, torque_balance.Method.INSTRUMENTAL)
    ]
    late = {"recursive_prediction_error": partial(_prediction_error, kind, parameters, deviations, support)}
    return EstimatorBank(regressions, late)


def _prediction_error(
    kind: str, parameters: Mapping[str, float], deviations: Mapping[str, float], support: float
) -> Estimator:
    from estimators.identify import nominal_model
    from estimators.recursive_prediction_error import RecursivePredictionError

    return RecursivePredictionError(nominal_model(kind), parameters=parameters, deviations=deviations, support=support)


class EstimatorBank:
    """Several estimators over the same cycles. One that fails is left out from there on, its failure its result.

    `late` ones, method to what makes it, take no part until `join`.
    """

    def __init__(
        self, estimators: Sequence[Estimator], late: Mapping[str, Callable[[], Estimator]] | None = None
    ) -> None:
        self._estimators = list(estimators)
        self._late = dict(late or {})
        self._waiting: list[Frame] = []
        self._failed: dict[str, dict[str, Any]] = {}

    @property
    def complete(self) -> bool:
        """Whether no estimator is missing."""
        return not self._late

    def join(self) -> None:
        """Make the late ones, which may take seconds, and let them catch up."""
        late, self._late = self._late, {}
        waiting, self._waiting = self._waiting, []
        for method, make in late.items():
            try:
                estimator = make()
            except Exception as error:  # Whatever it is, the recording and the others go on without it.
                self._fail(method, error)
            else:
                self._estimators.append(estimator)
                self._feed(estimator, waiting)

    def update(self, frames: Iterable[Frame]) -> None:
        """Take control cycles."""
        frames = list(frames)
        if self._late:
            self._waiting += frames
        for estimator in self._estimators:
            self._feed(estimator, frames)

    def results(self) -> dict[str, Any]:
        """Method to result, JSON-ready, as in `upright identify --json`."""
        results: dict[str, Any] = {}
        for estimator in self._estimators:
            if estimator.method not in self._failed:
                try:
                    results[estimator.method] = estimator.result().to_json()
                    continue
                except (ArithmeticError, ValueError) as error:
                    self._fail(estimator.method, error)
            results[estimator.method] = self._failed[estimator.method]
        return {**results, **dict.fromkeys(self._late, STARTING), **self._failed}

    def _feed(self, estimator: Estimator, frames: Iterable[Frame]) -> None:
        if estimator.method in self._failed:
            return
        try:
            for frame in frames:
                estimator.update(frame)
        except (ArithmeticError, ValueError) as error:
            self._fail(estimator.method, error)

    def _fail(self, method: str, error: Exception) -> None:
        self._failed[method] = {
            "parameters": {},
            "status": "failed",
            "reason": f"{type(error).__name__}: {error}",
        }
