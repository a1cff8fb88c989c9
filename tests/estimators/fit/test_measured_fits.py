"""Batch fits of measured records: parameters compared with published ones, predictions with held-out data."""

from __future__ import annotations

import runpy
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from upright.estimators.contract import Estimate
from upright.estimators.fit.problem import problem
from upright.estimators.identify.validation import Validation, validate

EXAMPLES = Path(__file__).parents[3] / "examples"
EMPS = runpy.run_path(str(EXAMPLES / "emps.py"))
DISK = runpy.run_path(str(EXAMPLES / "unbalanced_disk.py"))
DRONE = runpy.run_path(str(EXAMPLES / "quarter_drone.py"))


@pytest.fixture(scope="module")
def emps(measured_data: Path) -> tuple[dict[str, Estimate], dict[str, Validation]]:
    found, validations = EMPS["identify"](measured_data)
    return {each.method: each for each in found}, validations


@pytest.mark.measured
@pytest.mark.parametrize("method", ["prediction_error", "least_squares"])
@pytest.mark.parametrize("name", EMPS["PUBLISHED"])
def test_emps_estimates_are_within_one_percent_of_the_published_values(emps: Any, method: str, name: str) -> None:
    """The published values come from the same record by another method, least squares."""
    parameter = emps[0][method].parameters[name]
    assert parameter.value == pytest.approx(EMPS["PUBLISHED"][name], rel=0.01)
    assert parameter.std < 0.1 * abs(parameter.value)


@pytest.mark.measured
def test_emps_output_error_is_within_three_of_its_standard_deviations(emps: Any) -> None:
    """A free simulation integrates slow friction changes twice: its error exceeds 1 %, and its +- has to show this."""
    for name, published in EMPS["PUBLISHED"].items():
        parameter = emps[0]["output_error"].parameters[name]
        assert abs(parameter.value - published) < 3.0 * parameter.std, name


@pytest.mark.measured
def test_emps_is_simulated_better_than_with_the_published_values(emps: Any) -> None:
    validations = emps[1]
    assert len(validations["published"].time[0]) == 24_841, "the simulation begins at the first sample"
    for method in ("prediction_error", "output_error"):
        assert validations[method].error["position"] < validations["published"].error["position"]
    # A step of 1 ms is predicted to 0.1 um, of the 0.25 m that the axis moves.
    assert validations["prediction_error"].one_step["position"] > 99.9998


@pytest.mark.measured
def test_unbalanced_disk_is_simulated_on_held_out_data(measured_data: Path) -> None:
    found = DISK["identify"](measured_data)
    estimate, held_out = found["output_error"]
    # 3.1 minutes without correction by the angle; with a wrong period the phase would be lost completely by 60 s.
    assert held_out.simulation["angle"] > 93.0
    assert found["prediction_error"][1].one_step["angle"] > 99.3  # an encoder step is 0.2 % of the movement, RMS
    for each, _ in found.values():
        # The table's voltage acts one sample later, and the disk's hanging angle is not the encoder's zero.
        assert each.parameters["input_delay.delay"].value == pytest.approx(0.025, abs=0.001)
        assert each.parameters["sensor_offset.offset"].value == pytest.approx(0.034, abs=0.002)
    # Small oscillations about the hanging angle have 11.6 rad/s in both fits, though they weigh errors differently.
    both = [each.parameters["gravity"].value for each, _ in found.values()]
    assert both[0] == pytest.approx(both[1], rel=0.01)
    assert estimate.values["coulomb_friction.torque"] > 0.0


@pytest.mark.measured
def test_quarter_drone_is_predicted_on_held_out_records(measured_data: Path) -> None:
    estimate, validations = DRONE["identify"](measured_data)
    for name in DRONE["HELD_OUT"]:
        assert len(validations[name].time) == 1, "no gap splits a record of 10 000 even rows"
        assert validations[name].one_step["angle"] > 99.7
        # As good as on the fitted records (90 %): there is no overfitting.
        assert validations[name].ahead["angle"] > 90.0
    assert validations["sinal3_swept_sine"].simulation["angle"] > 85.0
    # Hovering at 45 deg takes 38.5 % throttle in all records; the two parameters together must reproduce this.
    hover = np.sqrt(estimate.values["gravity"] * np.sin(np.pi / 4) / estimate.values["thrust"])
    assert hover == pytest.approx(0.385, rel=0.05)


def test_model_with_the_true_values_is_perfect_on_a_noise_free_record() -> None:
    """An axis of 2 kg under a square wave, computed by hand; a wrong mass lowers the figures by the expected amount."""
    from upright.estimators.methods import prediction_error
    from upright.telemetry.channels import Channel, ChannelTable
    from upright.telemetry.recording import Recording

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
    # Twice the mass moves half as far: the error is half of the position, including its mean.
    wrong = validate(fitted, [clean], values={"inertia": 4.0})
    expected = 100.0 * (1.0 - np.sqrt(np.mean((0.5 * position) ** 2)) / np.std(position))
    assert wrong.simulation["position"] == pytest.approx(expected, abs=1e-6)
    assert "simulation" in str(wrong)
