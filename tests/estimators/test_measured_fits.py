"""Measured records through the batch fits: parameters against published ones, predictions against held-out data."""

from __future__ import annotations

import runpy
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from estimators.contract import Estimate
from estimators.fit.problem import problem
from estimators.identify.validation import Validation, validate

EXAMPLES = Path(__file__).parents[2] / "examples"
EMPS = runpy.run_path(str(EXAMPLES / "emps.py"))
DISK = runpy.run_path(str(EXAMPLES / "unbalanced_disk.py"))
DRONE = runpy.run_path(str(EXAMPLES / "quarter_drone.py"))


@pytest.fixture(scope="module")
def emps(measured_data: Path) -> tuple[dict[str, Estimate], dict[str, Validation]]:
    found, worth = EMPS["identify"](measured_data)
    return {each.method: each for each in found}, worth


@pytest.mark.measured
@pytest.mark.parametrize("method", ["prediction_error", "least_squares"])
@pytest.mark.parametrize("name", EMPS["PUBLISHED"])
def test_emps_is_within_a_percent_of_what_is_published(emps: Any, method: str, name: str) -> None:
    """The published values come from the same record by another method, least squares."""
    parameter = emps[0][method].parameters[name]
    assert parameter.value == pytest.approx(EMPS["PUBLISHED"][name], rel=0.01)
    assert parameter.std < 0.1 * abs(parameter.value)


@pytest.mark.measured
def test_emps_output_error_is_as_far_off_as_it_says(emps: Any) -> None:
    """A free simulation integrates slow friction changes twice: it is worse than 1 %, and its +- has to say so."""
    for name, published in EMPS["PUBLISHED"].items():
        parameter = emps[0]["output_error"].parameters[name]
        assert abs(parameter.value - published) < 3.0 * parameter.std, name


@pytest.mark.measured
def test_emps_is_predicted_and_simulated_as_well_as_by_the_published_values(emps: Any) -> None:
    worth = emps[1]
    assert len(worth["published"].time[0]) == 24_841, "the simulation begins at the first sample"
    for method in ("prediction_error", "output_error"):
        assert worth[method].error["position"] < worth["published"].error["position"]
    # A step of 1 ms is predicted to 0.1 um, of the 0.25 m that the axis moves.
    assert worth["prediction_error"].one_step["position"] > 99.9998


@pytest.mark.measured
def test_the_unbalanced_disk_is_simulated_where_it_was_never_fitted(measured_data: Path) -> None:
    found = DISK["identify"](measured_data)
    estimate, held_out = found["output_error"]
    # 3.1 minutes without a look at the angle; by 60 s a wrong period would have lost the phase altogether.
    assert held_out.simulation["angle"] > 93.0
    assert found["prediction_error"][1].one_step["angle"] > 99.3  # an encoder step is 0.2 % of the movement, RMS
    for each, _ in found.values():
        # The table's voltage acts one row later, and the disk's hanging angle is not the encoder's zero.
        assert each.parameters["input_delay.delay"].value == pytest.approx(0.025, abs=0.001)
        assert each.parameters["sensor_offset.offset"].value == pytest.approx(0.034, abs=0.002)
    # Small oscillations about the hanging angle have 11.6 rad/s in both fits, though they weigh errors differently.
    both = [each.parameters["gravity"].value for each, _ in found.values()]
    assert both[0] == pytest.approx(both[1], rel=0.01)
    assert estimate.values["coulomb_friction.torque"] > 0.0


@pytest.mark.measured
def test_the_quarter_drone_is_predicted_on_records_that_it_was_not_fitted_to(measured_data: Path) -> None:
    estimate, worth = DRONE["identify"](measured_data)
    for name in DRONE["HELD_OUT"]:
        assert len(worth[name].time) == 1, "no gap splits a record of 10 000 even rows"
        assert worth[name].one_step["angle"] > 99.7
        # As on the records that were fitted (90 %): nothing was fitted that is not in the machine.
        assert worth[name].ahead["angle"] > 90.0
    assert worth["sinal3_swept_sine"].simulation["angle"] > 85.0
    # Hovering at 45 deg takes 38.5 % throttle in all records: what the two parameters together must say.
    hover = np.sqrt(estimate.values["gravity"] * np.sin(np.pi / 4) / estimate.values["thrust"])
    assert hover == pytest.approx(0.385, rel=0.05)


def test_a_model_with_the_true_values_is_perfect_on_a_record_without_noise() -> None:
    """An axis of 2 kg under a square wave, worked out by hand; a wrong mass shows as what it is worth."""
    from estimators.methods import prediction_error
    from telemetry.channels import Channel, ChannelTable
    from telemetry.recording import Recording

    step = 0.01
    force = np.repeat(np.where(np.arange(40) % 2 == 0, 1.0, -1.0), 25)
    rate = np.concatenate(([0.0], np.cumsum(force / 2.0 * step)))[:-1]
    position = np.concatenate(([0.0], np.cumsum(rate * step + 0.25 * force * step**2)))[:-1]
    channels = ChannelTable((Channel("position", "m", ""), Channel("force", "N", "")))
    time = np.arange(len(force), dtype=np.int64) * 10_000_000
    noisy = position + 1e-4 * np.random.default_rng(1).standard_normal(len(force))
    train = Recording(channels, time, {"position": noisy, "force": force})
    frictionless = EMPS["model"]().change({"inertia": 1.8}, estimated=["inertia"])
    fitted = prediction_error.fit(problem(frictionless, [train]))
    assert fitted.values[0] == pytest.approx(2.0, rel=0.01)
    clean = Recording(channels, time, {"position": position, "force": force})
    right = validate(fitted, [clean], values={"inertia": 2.0})
    assert right.simulation["position"] == pytest.approx(100.0, abs=1e-6)
    assert right.error["position"] == pytest.approx(0.0, abs=1e-9)
    # Twice the mass moves half as far: half of the position, whose mean counts as error, too.
    wrong = validate(fitted, [clean], values={"inertia": 4.0})
    expected = 100.0 * (1.0 - np.sqrt(np.mean((0.5 * position) ** 2)) / np.std(position))
    assert wrong.simulation["position"] == pytest.approx(expected, abs=1e-6)
    assert "simulation" in str(wrong)
