"""Identification of recordings with the recursive estimators, side by side: what `upright identify` prints.

Every recording runs through one estimator a method, in the order given, so several recordings give one result. How well
the identified model predicts is told beside it: roll and roll rate half a second ahead from the measured state.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from estimators.balance_rows import BALANCE_CHANNELS, INSTRUMENT_CHANNELS
from estimators.contract import Estimate, EstimationError, Status
from estimators.prediction import free_motion, predict, sensor_noise
from estimators.torque_balance import NUISANCE, Method, TorqueBalance
from telemetry.recording import Recording

FIT_HORIZON = 0.5
"""s ahead that fit_percent tells of."""


def identify(
    recordings: Sequence[Recording],
    parameters: Mapping[str, float],
    support: float,
    methods: Sequence[str] = (Method.PLAIN, Method.INSTRUMENTAL),
    *,
    deviations: Mapping[str, float] | None = None,
    stopwatch: Callable[[], float] = lambda: 0.0,
) -> dict[str, Any]:
    """The document of `identify --json`: for each method its parameters, fit, status, reason and seconds.

    `parameters` and `deviations` are the vehicle file's; `support` is in rad. `stopwatch` gives seconds that go by: the
    caller's clock, since estimators have none.
    Raises EstimationError for a method or parameter that is not there, RecordingError for a missing channel.
    """
    unknown = set(methods) - set(Method)
    if unknown:
        remedy = f"choose among {', '.join(Method)}."
        raise EstimationError(f"method {min(unknown)}", "there is no such method", remedy=remedy)
    document: dict[str, Any] = {}
    for method in map(Method, methods):
        start = stopwatch()
        channels = INSTRUMENT_CHANNELS if method is Method.INSTRUMENTAL else BALANCE_CHANNELS
        estimator = TorqueBalance(parameters, support, method=method, deviations=deviations, channels=channels)
        for recording in recordings:
            for frame in recording.frames(channels):
                estimator.update(frame)
        estimate = estimator.result()
        fit = fit_percent(recordings, identified(parameters, estimate), support) if estimate.status is Status.OK else {}
        document[method.value] = {**estimate.to_json(), "fit_percent": fit, "seconds": stopwatch() - start}
    return {"methods": document}


def identified(parameters: Mapping[str, float], estimate: Estimate) -> dict[str, float]:
    """`parameters` with those replaced or added that `estimate` determines; what is a sensor's nuisance stays out."""
    known = {name: p.value for name, p in estimate.parameters.items() if p.value is not None and name != NUISANCE}
    return {**parameters, **known}


def fit_percent(recordings: Sequence[Recording], parameters: Mapping[str, float], support: float) -> dict[str, float]:
    """Percent of roll and roll rate that the model predicts FIT_HORIZON ahead; empty where nothing is that long."""
    stretches = [stretch for recording in recordings for stretch in free_motion(recording, support)]
    if not stretches:
        return {}
    prediction = predict(stretches, parameters, FIT_HORIZON, sensor_noise(stretches))
    if prediction is None:
        return {}
    return {channel: prediction.fit_percent(channel) for channel in ("roll", "roll_rate")}
