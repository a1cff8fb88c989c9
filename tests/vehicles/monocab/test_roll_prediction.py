"""The measure that `identify` applies to all methods: free motion, its sensor noise, and predictions from it."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
import small_vehicle

from upright.estimators.identify.run import identify, with_values
from upright.estimators.identify.subject import Subject
from upright.models import library
from upright.telemetry.channels import ChannelTable
from upright.telemetry.recording import Recording
from upright.vehicles.monocab.identification.own import OWN
from upright.vehicles.monocab.identification.roll_prediction import free_motion, sensor_noise
from upright.vehicles.registry import nominal_model

SUPPORT = float(np.radians(4.0))
RECURSIVE = ("recursive_least_squares", "recursive_instrumental_variables")
CAD = {
    "inertia": 1450.0,
    "gravity_stiffness": 12600.0,
    "angular_momentum": 3300.0,
    "trim_mass": 500.0,
    "trim_height": 0.4,
}
MODEL = with_values(nominal_model("monocab"), CAD, {})


@pytest.fixture(scope="module")
def sweep() -> Recording:
    return small_vehicle.recording(*small_vehicle.run(1, 31.0, reference=lambda t: small_vehicle.sweep(t, 30.0)), 0)


def test_sensor_noise_is_estimated_from_the_record(sweep: Recording) -> None:
    noise = sensor_noise(free_motion(sweep, SUPPORT))
    assert noise.roll_rate_std == pytest.approx(3.5e-5 / np.sqrt(2 * 0.004), rel=0.05)
    assert 0.5e-4 < noise.roll_std < 3e-4


def test_free_motion_ends_at_the_support_at_gaps_and_at_unknown_values(sweep: Recording) -> None:
    values = {name: column.copy() for name, column in sweep.values.items()}
    values["roll"][1000:1100] = SUPPORT
    values["precession_rate"][3000] = np.nan
    keep = np.r_[0:5000, 5100 : len(sweep)]
    damaged = Recording(sweep.channels, sweep.timestamp_ns[keep], {n: v[keep] for n, v in values.items()})
    lengths = [len(segment.time) for segment in free_motion(damaged, SUPPORT)]
    assert lengths == [1000, 1900, 1999, len(sweep) - 5100]


def test_identify_document_has_status_parameters_and_fit_of_each_method(sweep: Recording) -> None:
    document = identify([sweep], CAD, SUPPORT, RECURSIVE, model=MODEL, own=OWN)
    json.dumps(document, allow_nan=False)
    assert tuple(document["methods"]) == RECURSIVE
    for method in document["methods"].values():
        assert method["status"] == "ok"
        assert method["seconds"] > 0.0
        assert method["parameters"]["inertia"]["value"] == pytest.approx(1650.0, rel=0.01)
        assert method["parameters"]["inertia"]["identifiable"]
        assert method["fit_percent"]["roll"] > 90.0


def test_missing_channel_is_named_in_the_reason(sweep: Recording) -> None:
    names = [channel for channel in sweep.channels if channel.name != "drive_age"]
    fewer = Recording(ChannelTable(names), sweep.timestamp_ns, {c.name: sweep.values[c.name] for c in names})
    entry = identify([fewer], CAD, SUPPORT, RECURSIVE, model=MODEL, own=OWN)["methods"][RECURSIVE[0]]
    assert entry["status"] == "missing_channel"
    assert "drive_age" in entry["reason"]


def test_two_recordings_give_a_smaller_standard_deviation_than_one(sweep: Recording) -> None:
    step = small_vehicle.recording(*small_vehicle.run(1, 8.0, from_support=True), 0)
    method = RECURSIVE[0]
    alone, both = (
        identify(given, CAD, SUPPORT, [method], model=MODEL, own=OWN)["methods"][method]
        for given in ([step], [step, sweep])
    )
    name = "static_torque.torque"
    assert both["parameters"][name]["std"] < alone["parameters"][name]["std"]


def test_roll_prediction_is_limited_to_shipped_roll_models_without_other_effects(sweep: Recording) -> None:
    roll = library.get("monocab_roll")
    measured = OWN.prediction(Subject(roll.add("static_torque"), CAD, {}, SUPPORT), [sweep])
    assert measured is not None
    assert measured.horizon == 0.5
    for other in (roll.add("viscous_friction"), library.get("monocab_gimbals"), replace(roll, name="mine")):
        assert OWN.prediction(Subject(other, CAD, {}, SUPPORT), [sweep]) is None
