"""The roll filter, fed through the IMU driver with CAN frames, on measured motion with optical ground truth."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from benchmarks import broad
from upright.vehicles import file as vehicle_file


@pytest.fixture(scope="module")
def trials(measured_data: Path) -> dict[str, Path]:
    return {path.name[:2]: path for path in (measured_data / "broad").glob("*.hdf5")}


# VQF's published figures for these trials are known. The bound is 1.25 times the error of VQF in the same run.
@pytest.mark.measured
@pytest.mark.parametrize(("number", "published"), [("02", 0.43), ("09", 0.87), ("24", 0.61)])
def test_inclination_error_is_at_most_a_quarter_larger_than_that_of_vqf(
    trials: dict[str, Path], number: str, published: float
) -> None:
    score = broad.score(trials[number], int16=False)
    assert score.vqf == pytest.approx(published, abs=0.006)
    assert score.ratio <= 1.25
    assert score.upright <= 1.25 * published


def test_benchmark_uses_the_shipped_filter_settings() -> None:
    config = broad.shipped_filter(285.7)
    section = vehicle_file.load("monocab").imu.filter
    assert config.acceleration_std == section.acceleration_std
    assert config.angular_rate_density == section.angular_rate_density
    assert config.bias_random_walk == section.bias_random_walk


def test_score_skips_samples_without_truth_or_outside_of_the_movement() -> None:
    up = np.tile([0.0, 0.0, 1.0], (8, 1))
    truth = np.tile([0.0, math.sin(0.1), math.cos(0.1)], (8, 1))
    truth[2] = np.nan
    truth[6] = [0.0, 0.0, -1.0]
    moving = np.array([False, True, True, True, True, True, False, False])
    trial = broad.Trial("made", 100.0, np.zeros((8, 3)), np.zeros((8, 3)), truth, moving)
    assert broad.inclination_rmse(trial, up, 0.0) == pytest.approx(math.degrees(0.1))


def test_up_vector_of_a_quaternion() -> None:
    half = math.radians(30.0) / 2.0
    rolled = np.array([[math.cos(half), math.sin(half), 0.0, 0.0]])
    assert broad.up_vector(rolled)[0] == pytest.approx([0.0, math.sin(2 * half), math.cos(2 * half)])
