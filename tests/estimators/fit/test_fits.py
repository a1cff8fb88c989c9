"""Prediction error and output error on the virtual vehicle: correct values, and none if the data do not determine them.

The vehicle is the independent plant: mechanical inertia 1650 kg m^2, gravity stiffness 14500 N m/rad. The measured
precession rate is the models' input, so these two values must result, whatever the speed loop does.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from upright import estimators
from upright.estimators.contract import Estimate, EstimationError, Status
from upright.estimators.data.segments import DataError, clipped_share, segments
from upright.models import library
from upright.models.model import Model
from upright.models.parts import ModelError
from upright.service.virtual.run import record
from upright.telemetry.channels import ChannelTable
from upright.telemetry.recording import Recording

TRUTH = {"inertia": 1650.0, "gravity_stiffness": 14500.0, "static_torque.torque": 0.0}
FITS = (estimators.prediction_error, estimators.output_error)
Fit = Callable[..., Estimate]


@pytest.fixture(scope="module")
def model() -> Model:
    """Held parameters are known exactly here, so that standard deviations come from the data alone."""
    exact = dict.fromkeys(("angular_momentum", "trim_mass", "trim_height"), 0.0)
    return library.get("monocab_roll").add("static_torque").change(deviations=exact)


@pytest.fixture(scope="module")
def multisine() -> Recording:
    return record("monocab", "multisine", seed=5)


@pytest.fixture(scope="module")
def hold() -> Recording:
    return record("monocab", "hold", seed=5)


def with_values(recording: Recording, **values: np.ndarray) -> Recording:
    return replace(recording, values={**recording.values, **values})


def part_of(recording: Recording, keep: np.ndarray | slice) -> Recording:
    values = {name: column[keep] for name, column in recording.values.items()}
    return replace(recording, timestamp_ns=recording.timestamp_ns[keep], values=values)


@pytest.mark.parametrize("fit", FITS)
def test_estimates_are_within_four_standard_deviations_and_one_percent_of_the_truth(
    fit: Fit, model: Model, multisine: Recording
) -> None:
    """Four standard deviations: one false alarm in 16000 for each of three parameters if the seed were not fixed."""
    estimate = fit(model, [multisine])
    assert estimate.status is Status.OK, estimate.reason
    for name, truth in TRUTH.items():
        found = estimate.parameters[name]
        assert found.value is not None
        assert found.std is not None
        assert abs(found.value - truth) < 4.0 * found.std
    assert estimate.values["inertia"] == pytest.approx(1650.0, rel=0.01)
    assert estimate.values["gravity_stiffness"] == pytest.approx(14500.0, rel=0.01)
    assert min(estimate.fit_percent.values()) > 95.0


def test_joint_fit_of_two_recordings_is_more_precise_than_either_fit(model: Model, multisine: Recording) -> None:
    half = len(multisine) // 2
    parts = [part_of(multisine, slice(0, half)), part_of(multisine, slice(half, None))]
    together = estimators.prediction_error(model, parts)
    alone = [estimators.prediction_error(model, [part]) for part in parts]
    for name in ("inertia", "gravity_stiffness"):
        assert together.parameters[name].std < min(each.parameters[name].std for each in alone)


def test_simplex_finds_the_same_values_as_the_trust_region(model: Model, multisine: Recording) -> None:
    short = part_of(multisine, slice(2000, 4000))
    exact, simplex = estimators.output_error(model, [short]), estimators.output_error_simplex(model, [short])
    for name, value in exact.values.items():
        assert simplex.values[name] == pytest.approx(value, abs=0.2 * exact.parameters[name].std)


def test_gaps_and_unknown_values_do_not_bias_the_estimates(model: Model, multisine: Recording) -> None:
    random = np.random.default_rng(3)
    holes = np.where(random.random(len(multisine)) < 0.01, np.nan, multisine["roll_rate"])
    keep = np.ones(len(multisine), dtype=bool)
    keep[3000:3100] = keep[6000:6500] = False
    estimate = estimators.prediction_error(model, [part_of(with_values(multisine, roll_rate=holes), keep)])
    for name in ("inertia", "gravity_stiffness"):
        found = estimate.parameters[name]
        assert abs(found.value - TRUTH[name]) < 4.0 * found.std


@pytest.mark.parametrize("fit", FITS)
def test_three_seconds_of_quiet_balancing_give_a_reason_instead_of_values(
    fit: Fit, model: Model, hold: Recording
) -> None:
    quiet = part_of(hold, (hold.time > 12.0) & (hold.time < 15.0))
    estimate = fit(model, [quiet])
    assert estimate.status in (Status.TOO_LITTLE_EXCITATION, Status.UNIDENTIFIABLE, Status.NOT_CONVERGED)
    for name in ("inertia", "gravity_stiffness"):
        assert estimate.parameters[name].value is None
        assert estimate.parameters[name].reason


@pytest.mark.parametrize("fit", FITS)
def test_balance_without_a_known_scale_is_not_identifiable(fit: Fit, model: Model, multisine: Recording) -> None:
    names = ["inertia", "gravity_stiffness", "angular_momentum"]
    loose = model.change(estimated=names, deviations=dict.fromkeys(names, 0.0))
    estimate = fit(loose, [multisine])
    assert all(parameter.value is None for parameter in estimate.parameters.values())
    assert {parameter.status for parameter in estimate.parameters.values()} == {Status.UNIDENTIFIABLE}


BAD = {
    "roll rate in degrees": ({"roll_rate": lambda r: np.degrees(r["roll_rate"])}, "degrees"),
    "gimbal rate in degrees": ({"precession_rate": lambda r: np.degrees(r["precession_rate"])}, "degrees"),
    "roll rate of the wrong sign": ({"roll_rate": lambda r: -r["roll_rate"]}, "-1 times the derivative"),
    "roll and roll rate swapped": (
        {"roll": lambda r: r["roll_rate"], "roll_rate": lambda r: r["roll"]},
        "not the derivative of roll",
    ),
    "roll rate cut off": ({"roll_rate": lambda r: np.clip(r["roll_rate"], -0.06, 0.06)}, "clipped at 0.06"),
    "roll rate stuck": ({"roll_rate": lambda r: 0.0 * r["roll_rate"]}, "never moves"),
}


@pytest.mark.parametrize("fit", FITS)
@pytest.mark.parametrize("case", BAD)
def test_bad_data_give_no_values_and_the_reason_names_the_fault(
    fit: Fit, case: str, model: Model, multisine: Recording
) -> None:
    changes, words = BAD[case]
    bad = with_values(multisine, **{name: change(multisine) for name, change in changes.items()})
    estimate = fit(model, [bad])
    assert estimate.status is Status.BAD_DATA
    assert words in estimate.reason
    assert all(parameter.value is None for parameter in estimate.parameters.values())


def test_missing_channel_is_named_in_the_reason(model: Model, multisine: Recording) -> None:
    channels = ChannelTable(channel for channel in multisine.channels if channel.name != "precession_rate")
    values = {name: column for name, column in multisine.values.items() if name != "precession_rate"}
    estimate = estimators.prediction_error(model, [replace(multisine, channels=channels, values=values)])
    assert estimate.status is Status.MISSING_CHANNEL
    assert "precession_rate" in estimate.reason


def test_record_on_the_support_is_refused_as_too_few_samples(model: Model, multisine: Recording) -> None:
    with pytest.raises(DataError) as refused:
        segments(model, [part_of(multisine, multisine.time < 3.0)])
    assert refused.value.status is Status.TOO_FEW_SAMPLES
    assert "upright" in str(refused.value)


def test_resting_on_a_support_at_an_unexpected_angle_is_not_free_motion(model: Model, multisine: Recording) -> None:
    (right,) = segments(model, [multisine])
    # The IMU shows half a degree less: judged by the nominal support angle, the resting vehicle would count as free.
    (found,) = segments(model, [with_values(multisine, roll=multisine["roll"] - np.radians(0.5))])
    assert (found.time[0], found.time[-1]) == pytest.approx((right.time[0], right.time[-1]), abs=0.1)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"estimate": ["weight"]}, "weight"),
        ({"estimate": []}, "no parameter is to be estimated"),
    ],
)
def test_unknown_or_empty_parameter_list_is_refused(
    changes: dict, words: str, model: Model, multisine: Recording
) -> None:
    with pytest.raises((ModelError, EstimationError), match=words):
        estimators.prediction_error(model, [multisine], **changes)


def test_start_outside_the_bounds_and_window_of_zero_are_refused(model: Model, multisine: Recording) -> None:
    with pytest.raises(EstimationError, match="outside"):
        estimators.output_error(model.change({"inertia": -5.0}), [multisine])
    with pytest.raises(EstimationError, match="window"):
        estimators.output_error(model, [multisine], window=0.0)


def test_clipping_is_distinguished_from_standing_still() -> None:
    time = np.arange(0.0, 20.0, 0.004)
    swing = np.sin(2.0 * np.pi * 0.5 * time)
    assert clipped_share(swing) == 0.0
    # Quantised rest at both ends, as of a positioning axis: the extreme value lasts long, but is reached slowly.
    plateau = np.round(0.5 * (1.0 - np.cos(np.pi * np.clip(time % 4.0, 0.0, 1.0))), 4)
    assert clipped_share(plateau) == 0.0
    assert clipped_share(np.clip(swing, -0.8, 0.8)) == pytest.approx(2.0 * np.arccos(0.8) / np.pi, rel=0.05)


def test_readings_that_are_repeated_since_none_came_are_not_clipped(model: Model, multisine: Recording) -> None:
    """A drive that does not answer for ten cycles just before the gimbals are furthest out."""
    precession, age = multisine["precession"].copy(), multisine["drive_age"].copy()
    first = int(np.argmax(precession)) - 10
    held = slice(first, first + 10)
    precession[held] = 1.001 * precession.max()  # on the way out, and the largest by a little noise
    silent = with_values(multisine, precession=precession)
    with pytest.raises(DataError, match="precession: is clipped"):
        segments(model, [silent])
    age[held] += np.arange(10) / multisine.rate
    assert segments(model, [with_values(silent, drive_age=age)])


def test_estimate_is_shown_as_text_html_and_json(model: Model, multisine: Recording) -> None:
    estimate = estimators.output_error(model, [multisine])
    text, html, document = str(estimate), estimate._repr_html_(), estimate.to_json()
    assert "±" in text
    assert "kg m^2" in text
    assert html.startswith("<div>")
    assert set(document["parameters"]["inertia"]) >= {"value", "std", "unit", "identifiable"}
    assert -1.0 <= document["correlation"]["gravity_stiffness"]["inertia"] <= 1.0
    assert document["seconds"] > 0.0
