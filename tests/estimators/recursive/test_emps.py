"""The EMPS record of a real positioning axis, estimated by the recursive least squares of the vehicles."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from axis_balance import AxisBalance

from upright.estimators.contract import Status
from upright.telemetry.channels import Channel, ChannelTable
from upright.telemetry.samples import Frame

CHANNELS = ChannelTable((Channel("position", "m", "of the carriage"), Channel("force", "N", "of the motor on it")))
FORCE_PER_VOLT = 35.15065
PUBLISHED = {"mass": 95.11, "viscous_friction": 203.5, "coulomb_friction": 20.39, "force_offset": -3.16}


@pytest.mark.measured
def test_emps_within_two_percent_of_the_published_values(measured_data: Path) -> None:
    data = np.genfromtxt(measured_data / "emps" / "emps.csv", delimiter=",", names=True)
    estimator = AxisBalance(CHANNELS)
    for time, position, voltage in zip(data["time"], data["position"], data["motor_voltage"], strict=True):
        estimator.update(Frame(round(time * 1e9), (position, FORCE_PER_VOLT * voltage)))
    estimate = estimator.result()
    assert estimate.status is Status.OK
    for name, published in PUBLISHED.items():
        parameter = estimate.parameters[name]
        assert parameter.value == pytest.approx(published, rel=0.02), name
        assert abs(parameter.value - published) < 3.0 * parameter.std


def feed(position: np.ndarray, force: np.ndarray) -> AxisBalance:
    estimator = AxisBalance(CHANNELS)
    for step, values in enumerate(zip(position.tolist(), force.tolist(), strict=True)):
        estimator.update(Frame(step * 1_000_000, values))
    return estimator


def test_known_parameters_of_a_simulated_axis_are_recovered() -> None:
    time = np.arange(0.0, 8.0, 0.001)
    velocity = 0.2 * np.sin(3.0 * time) * np.sin(0.7 * time)
    acceleration = np.gradient(velocity, time)
    position = np.concatenate(([0.0], np.cumsum(0.0005 * (velocity[1:] + velocity[:-1]))))
    force = 50.0 * acceleration + 80.0 * velocity + 6.0 * np.sign(velocity) + 1.5
    parameters = feed(position, force).result().parameters
    for name, truth in {"mass": 50.0, "viscous_friction": 80.0, "coulomb_friction": 6.0, "force_offset": 1.5}.items():
        assert parameters[name].value == pytest.approx(truth, rel=0.01), name


def test_axis_at_rest_gives_no_values_but_a_reason() -> None:
    time = np.arange(0.0, 3.0, 0.001)
    result = feed(np.zeros_like(time), np.full_like(time, 2.0)).result()
    assert result.status is Status.TOO_LITTLE_EXCITATION
    assert result.parameters["mass"].value is None
    assert "move the axis" in result.reason


def test_short_record_is_reported_as_too_few_samples() -> None:
    result = feed(np.zeros(50), np.zeros(50)).result()
    assert result.status is Status.TOO_FEW_SAMPLES
    assert all(parameter.value is None for parameter in result.parameters.values())
