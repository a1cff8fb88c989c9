"""The estimators that run for a kind of vehicle, live in the observer and in a replay, and the live diagnosis.

The recursive estimators of the compiled model and the diagnosis that monitors one of them are created late: on the
first start on a computer their models are compiled for some seconds, and neither the recording nor the other estimators
wait for that. The cycles are kept until they join, so that the results are the same as if they had run from the
beginning.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any, TypedDict, TypeVar, Unpack

from upright.estimators.contract import Estimator
from upright.telemetry.channels import ChannelTable
from upright.telemetry.samples import Frame
from upright.vehicles import registry
from upright.vehicles.experiment.load import asked_for
from upright.vehicles.sections import VehicleFile

if TYPE_CHECKING:
    from upright.diagnosis.live.live import LiveDiagnosis

Made = TypeVar("Made")

RECURSION = "recursive_prediction_error"
SIMULATION = "recursive_output_error"

LOADED = "the experiment asks for a load; `upright compare` and `upright diagnose` know it, live it would be an effect"
"""Why there is no live diagnosis of an experiment with a load."""

STARTING = {
    "parameters": {},
    "status": "starting",
    "reason": "its model is being compiled, once on a computer; the cycles so far are kept for it",
}


class Given(TypedDict):
    """What an estimator of a compiled model is told of its vehicle, as `online_estimators` is."""

    parameters: Mapping[str, float]
    deviations: Mapping[str, float]
    support: float
    channels: ChannelTable


def online_estimators(
    kind: str,
    parameters: Mapping[str, float],
    deviations: Mapping[str, float],
    support: float,
    channels: ChannelTable,
) -> EstimatorBank:
    """The estimators of a vehicle `kind`, the preferred one last: the recursive output error of its compiled model, its
    own regressions, and the recursive prediction error.

    `parameters` are the CAD values, `deviations` their standard deviations, `support` rad the angle on a support,
    `channels` what the cycles hold.
    Raises EstimationError if a parameter is missing.
    """
    found = registry.of(kind)
    own = found.identification().regressions.values()
    regressions = [each.make(parameters, deviations, support, channels) for each in own]
    given = Given(parameters=parameters, deviations=deviations, support=support, channels=channels)
    late = {RECURSION: partial(_live_diagnosis, kind, **given)}
    return EstimatorBank(regressions, late, {SIMULATION: partial(_simulation, kind, **given)})


def estimators_of(vehicle: VehicleFile) -> EstimatorBank:
    """The estimators of a vehicle, with the values of its file. Raises EstimationError like `online_estimators`."""
    known = vehicle.parameters
    return online_estimators(
        vehicle.vehicle.kind, known.values, known.deviations, vehicle.support, registry.recorded(vehicle)
    )


def _simulation(kind: str, **given: Unpack[Given]) -> Estimator:
    from upright.estimators.recursive.prediction_error import Method, RecursivePredictionError

    return RecursivePredictionError(registry.nominal_model(kind), method=Method(SIMULATION), **given)


def _live_diagnosis(kind: str, **given: Unpack[Given]) -> LiveDiagnosis:
    from upright.diagnosis.live.live import LiveDiagnosis

    return LiveDiagnosis(registry.nominal_model(kind), **given)


class EstimatorBank:
    """Several estimators over the same cycles. An estimator that fails is left out from then on; its failure is its
    result.

    `late` ones, given by method as factories of the estimator with its diagnosis, are inactive until `join`, and so are
    `late_first` ones, factories of estimators alone. The results are in the order `late_first`, `estimators`, `late`.
    """

    def __init__(
        self,
        estimators: Sequence[Estimator],
        late: Mapping[str, Callable[[], LiveDiagnosis]] | None = None,
        late_first: Mapping[str, Callable[[], Estimator]] | None = None,
    ) -> None:
        self._estimators = list(estimators)
        self._late = dict(late or {})
        self._late_first = dict(late_first or {})
        self._diagnoses = bool(late)
        self._live: LiveDiagnosis | None = None
        self._waiting: list[Frame] = []
        self._failed: dict[str, dict[str, Any]] = {}
        self._undiagnosed = ""

    def of_recording(self, metadata: Mapping[str, str]) -> None:
        """The cycles to come are those of a recording with this `metadata`."""
        self._undiagnosed = "" if asked_for(metadata) is None else LOADED

    @property
    def estimators(self) -> tuple[Estimator, ...]:
        """The estimators that have joined, the preferred one last."""
        return tuple(self._estimators)

    @property
    def complete(self) -> bool:
        """Whether all estimators have joined."""
        return not (self._late or self._late_first)

    def join(self) -> None:
        """Create the late estimators, which may take seconds, and process the cycles so far."""
        late, self._late = self._late, {}
        first, self._late_first = self._late_first, {}
        waiting, self._waiting = self._waiting, []
        joined = [made for method, make in first.items() if (made := self._made(method, make)) is not None]
        self._estimators[:0] = joined
        for method, make_diagnosed in late.items():
            live = self._made(method, make_diagnosed)
            if live is not None:
                self._live = live
                self._estimators.append(live.estimator)
                joined.append(live.estimator)
        for estimator in joined:
            self._feed(estimator, waiting)

    def update(self, frames: Iterable[Frame]) -> None:
        """Take control cycles."""
        frames = list(frames)
        if not self.complete:
            self._waiting += frames
        for estimator in self._estimators:
            self._feed(estimator, frames)

    def results(self) -> dict[str, Any]:
        """The results by method, JSON-ready, as in `upright identify --json`."""
        results: dict[str, Any] = {}
        for estimator in self._estimators:
            if estimator.method not in self._failed:
                try:
                    results[estimator.method] = estimator.result().to_json()
                    continue
                except (ArithmeticError, ValueError) as error:
                    self._fail(estimator.method, error)
            results[estimator.method] = self._failed[estimator.method]
        return {**results, **dict.fromkeys((*self._late_first, *self._late), STARTING), **self._failed}

    def diagnosis(self) -> dict[str, Any] | None:
        """The live diagnosis so far, JSON-ready as in `upright diagnose --json`; None for a kind of vehicle without a
        live diagnosis."""
        if self._diagnoses and self._undiagnosed:
            return {"adequate": False, "verdict": "insufficient_data", "reason": self._undiagnosed, "findings": []}
        if self._live is not None:
            return self._live.result().to_json()
        if self._diagnoses and (self._late or self._failed):
            reason = STARTING["reason"] if self._late else "; ".join(str(e["reason"]) for e in self._failed.values())
            return {"adequate": False, "verdict": "insufficient_data", "reason": reason, "findings": []}
        return None

    def _feed(self, estimator: Estimator, frames: Iterable[Frame]) -> None:
        if estimator.method in self._failed:
            return
        try:
            for frame in frames:
                estimator.update(frame)
        except (ArithmeticError, ValueError) as error:
            self._fail(estimator.method, error)

    def _made(self, method: str, make: Callable[[], Made]) -> Made | None:
        """What `make` creates; None if it fails, which is then the result of `method`."""
        try:
            return make()
        except Exception as error:  # In any case the recording and the others continue without it.
            self._fail(method, error)
            return None

    def _fail(self, method: str, error: Exception) -> None:
        self._failed[method] = {
            "parameters": {},
            "status": "failed",
            "reason": f"{type(error).__name__}: {error}",
        }
