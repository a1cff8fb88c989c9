"""Identification methods for a MONOCAB in addition to those for every model (estimators.identify.subject)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial

from upright import estimators
from upright.estimators.contract import Estimate, Estimator, ParameterEstimate
from upright.estimators.identify.subject import OwnMethods, Prediction, Regression, Subject, Values
from upright.telemetry.channels import ChannelTable
from upright.telemetry.errors import UprightError
from upright.telemetry.recording import Recording
from upright.vehicles.monocab.identification import torque_balance
from upright.vehicles.monocab.identification.balance_rows import BALANCE_CHANNELS, INSTRUMENT_CHANNELS
from upright.vehicles.monocab.model import MODELS

HORIZON = 0.5
"""s, horizon at which a fit is measured."""
MEASURED = ("roll", "roll_rate")
BALANCED = frozenset({"inertia", "gravity_stiffness"})

GIMBALS = {"setpoint": "precession_rate_setpoint", "rate": "precession_rate", "body_rate": "roll_rate"}
"""The channels of the gimbals' speed loops, as arguments of `estimators.drive_lag`."""


def drive_lag(recordings: Sequence[Recording]) -> Estimate:
    """The gimbals' speed loops, as `estimators.drive_lag`."""
    found: Estimate = estimators.drive_lag(recordings, **GIMBALS)
    return found


def trim_drive_lag(recordings: Sequence[Recording]) -> Estimate:
    """The speed loop of the trim mass, as `estimators.drive_lag`, without a reaction to the vehicle's motion."""
    found: Estimate = estimators.drive_lag(recordings, setpoint="trim_rate_setpoint", rate="trim_rate")
    return found


def _regression(
    method: torque_balance.Method, parameters: Values, deviations: Values, support: float, channels: ChannelTable
) -> Estimator:
    return torque_balance.make(parameters, support, method=method, deviations=deviations, channels=channels)


def _prediction(subject: Subject, recordings: Sequence[Recording]) -> Prediction | None:
    """Roll and roll rate, half a second ahead of the measured state, in closed form: for a shipped model with no more
    than a static torque; None for any other, or if the recordings lack what it needs."""
    from upright.vehicles.monocab.identification.roll_prediction import free_motion, predict, sensor_noise

    support, model = subject.support, subject.model
    plain = {effect.name for effect in model.effects} <= {"static_torque"}
    shipped = model.name in {each.name for each in MODELS}
    if support is None or not (plain and shipped and {each.name for each in model.parameters} >= BALANCED):
        return None
    try:
        segments = [segment for recording in recordings for segment in free_motion(recording, support)]
        noise = sensor_noise(segments)
    except UprightError:
        return None

    def percent(values: Values) -> dict[str, float]:
        if not values.keys() >= BALANCED:
            return {}
        prediction = predict(segments, {**subject.values, **values}, HORIZON, noise)
        return {} if prediction is None else {channel: prediction.fit_percent(channel) for channel in MEASURED}

    return Prediction(HORIZON, percent)


def _apparent_inertia(
    drives: Mapping[str, ParameterEstimate],
    best: Mapping[str, ParameterEstimate],
    vehicle: Mapping[str, tuple[float, float]],
) -> dict[str, ParameterEstimate]:
    """The apparent inertia in addition to the mechanical one of the best method: as measured, and by the formula."""
    from upright.vehicles.monocab.identification.apparent_inertia import (
        apparent_inertia_estimate,
        measured_apparent_inertia,
    )

    if "inertia" not in best or not {"speed_loop_lag", "roll_reaction"} <= drives.keys():
        return {}
    inertia, lag, reaction = best["inertia"], drives["speed_loop_lag"], drives["roll_reaction"]
    found = {}
    if "angular_momentum" in vehicle:
        momentum = vehicle["angular_momentum"]
        found["apparent_inertia"] = measured_apparent_inertia(inertia, reaction, momentum)
        if "gimbal_inertia" in vehicle:
            found["apparent_inertia_by_formula"] = apparent_inertia_estimate(
                inertia, lag, momentum, vehicle["gimbal_inertia"]
            )
    return found


OWN = OwnMethods(
    regressions={
        method.value: Regression(channels, partial(_regression, method))
        for method, channels in (
            (torque_balance.Method.PLAIN, BALANCE_CHANNELS),
            (torque_balance.Method.INSTRUMENTAL, INSTRUMENT_CHANNELS),
        )
    },
    asked=("recursive_output_error", "recursive_prediction_error", "drive_lag"),
    settings={"drive_lag": GIMBALS, "instrumental_variables": {"setpoint": GIMBALS["setpoint"]}},
    prediction=_prediction,
    derived=_apparent_inertia,
)
