"""The recursive prediction error and output error on the virtual vehicle, from CAD values that are 14 % off."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import estimators
from estimators.contract import Estimate, EstimationError, Status
from estimators.recursive_prediction_error import Method, RecursivePredictionError
from models import library
from models.model import Model
from service.replay import replay
from service.vehicle_file import load
from service.virtual_run import record
from telemetry.recording import Recording

VEHICLE = load("monocab")
TRUTH = {"inertia": 1650.0, "gravity_stiffness": 14500.0}


@pytest.fixture(scope="module")
def multisine() -> Recording:
    return record("monocab", "multisine", seed=9)


@pytest.fixture(scope="module")
def model() -> Model:
    return library.get("monocab_roll").add("static_torque")


def run(recording: Recording, model: Model, method: Method = Method.PREDICTION_ERROR) -> Estimate:
    estimator = RecursivePredictionError(
        model,
        parameters=VEHICLE.parameters.values,
        deviations=VEHICLE.parameters.deviations,
        support=VEHICLE.support,
        channels=recording.channels,
        method=method,
    )
    for frame in recording.frames():
        estimator.update(frame)
    return estimator.result()


def rows(recording: Recording, keep: np.ndarray) -> Recording:
    values = {name: column[keep] for name, column in recording.values.items()}
    return replace(recording, timestamp_ns=recording.timestamp_ns[keep], values=values)


@pytest.mark.parametrize("method", Method)
def test_truth_is_within_one_percent_and_inside_the_band(method: Method, model: Model, multisine: Recording) -> None:
    """The band is that of four standard deviations, most of which is the angular momentum's 0.45 %."""
    estimate = run(multisine, model, method)
    for name, truth in TRUTH.items():
        found = estimate.parameters[name]
        assert found.value == pytest.approx(truth, rel=0.01)
        assert abs(found.value - truth) < 4.0 * found.std


def test_it_ends_where_the_batch_fit_ends(model: Model, multisine: Recording) -> None:
    """By half a percent: one has seen every chunk once or twice, the other all of them at the final values."""
    batch = estimators.prediction_error(
        model.change(
            {name: value for name, value in VEHICLE.parameters.values.items() if name in model.values},
        ),
        [multisine],
    )
    live = run(multisine, model)
    for name in TRUTH:
        assert live.values[name] == pytest.approx(batch.values[name], rel=0.005)


def test_half_of_the_way_after_ten_seconds_of_balance(model: Model, multisine: Recording) -> None:
    early = run(rows(multisine, multisine.time < 16.0), model)
    for name, truth in TRUTH.items():
        start = VEHICLE.parameters.values[name]
        assert abs(early.values[name] - truth) < 0.1 * abs(start - truth)


def test_gaps_and_unknown_values_do_not_lead_it_astray(model: Model, multisine: Recording) -> None:
    random = np.random.default_rng(4)
    holes = np.where(random.random(len(multisine)) < 0.01, np.nan, multisine["roll_rate"])
    keep = np.ones(len(multisine), dtype=bool)
    keep[3000:3100] = keep[6000:6500] = False
    torn = rows(replace(multisine, values={**multisine.values, "roll_rate": holes}), keep)
    estimate = run(torn, model)
    for name, truth in TRUTH.items():
        assert estimate.values[name] == pytest.approx(truth, rel=0.01)


def test_on_the_support_it_knows_nothing_and_says_why(model: Model, multisine: Recording) -> None:
    estimate = run(rows(multisine, multisine.time < 3.0), model)
    assert estimate.status is Status.TOO_FEW_SAMPLES
    assert "support" in estimate.reason
    assert all(parameter.value is None for parameter in estimate.parameters.values())


def test_two_seconds_of_quiet_balance_are_too_little(model: Model) -> None:
    hold = record("monocab", "hold", seed=9)
    estimate = run(rows(hold, (hold.time > 12.0) & (hold.time < 14.0)), model)
    assert estimate.parameters["inertia"].value is None
    assert estimate.parameters["inertia"].reason


def test_reset_forgets_and_a_replay_gives_the_same_bits(model: Model, multisine: Recording) -> None:
    name = Method.PREDICTION_ERROR.value
    first, second = replay(multisine, VEHICLE)[name], replay(multisine, VEHICLE)[name]
    assert first == second
    assert first["parameters"]["inertia"]["identifiable"]


def test_what_cannot_be_is_refused(model: Model, multisine: Recording) -> None:
    with pytest.raises(EstimationError, match="memory"):
        RecursivePredictionError(model, memory=0.0)
    with pytest.raises(EstimationError, match="no parameter"):
        RecursivePredictionError(model.change(estimated=[]))
