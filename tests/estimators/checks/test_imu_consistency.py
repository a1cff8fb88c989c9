"""Accelerometer and gyro: vibration and shocks are no contradiction, a motion that one of them does not show is."""

from __future__ import annotations

import numpy as np
import pytest

from upright.estimators.checks.imu_consistency import ImuConsistency
from upright.vehicles.bounds import CONTRADICTION

RATE, STD = 250.0, 0.2
SECOND = round(RATE)


def largest(readings: np.ndarray) -> float:
    """The largest result while `readings` (n, 3) come in."""
    subject = ImuConsistency(RATE, STD)
    return max(subject.update(tuple(each)) for each in readings.tolist())


def noise(seconds: float, std: float = STD, seed: int = 1) -> np.ndarray:
    return std * np.random.default_rng(seed).standard_normal((round(seconds * RATE), 3))


def test_means_of_noise_have_their_stated_deviation() -> None:
    subject = ImuConsistency(RATE, STD)
    readings = noise(400.0)
    readings[:, 1:] = 0.0
    found = np.array([subject.update(tuple(each)) for each in readings.tolist()])
    # The larger of two standard normal variables, which depend on each other; readings are clipped at three deviations.
    assert 1.0 < np.sqrt(np.mean(found[SECOND:] ** 2)) < np.sqrt(2.0)
    assert found.max() < CONTRADICTION


@pytest.mark.parametrize(("frequency", "times"), [(8.0, 2.0), (25.0, 5.0)])
def test_vibration_stronger_than_stated_is_no_contradiction(frequency: float, times: float) -> None:
    time = np.arange(20 * SECOND) / RATE
    shaken = noise(20.0)
    shaken[:, 1] += times * STD * np.sin(2.0 * np.pi * frequency * time)
    assert largest(shaken) < CONTRADICTION


def test_a_shock_is_no_contradiction() -> None:
    readings = noise(2.0)
    readings[SECOND : SECOND + 3] += 30.0  # 3 g for 12 ms
    assert largest(readings) < CONTRADICTION


@pytest.mark.parametrize(("step", "within"), [(1.0, 0.05), (0.5, 0.12)])
def test_a_motion_that_one_of_them_does_not_show_is_found(step: float, within: float) -> None:
    """`step` m/s^2: 6 deg of tilt, or 3."""
    subject = ImuConsistency(RATE, STD)
    readings = noise(4.0)
    readings[2 * SECOND :, 1] += step
    found = np.array([subject.update(tuple(each)) for each in readings.tolist()])
    assert found[: 2 * SECOND].max() < CONTRADICTION
    assert np.argmax(found > CONTRADICTION) - 2 * SECOND <= within * RATE


def test_a_small_motion_is_found_if_it_lasts() -> None:
    """0.13 m/s^2: what the lever arm and the lean of a rising vehicle together leave."""
    subject = ImuConsistency(RATE, STD)
    readings = noise(4.0)
    readings[2 * SECOND :, 1] += 0.13
    found = np.array([subject.update(tuple(each)) for each in readings.tolist()])
    assert found[: 2 * SECOND].max() < CONTRADICTION
    assert 0 < np.argmax(found > CONTRADICTION) - 2 * SECOND <= 0.5 * RATE


def test_an_error_of_scale_that_shows_at_rest_is_no_contradiction() -> None:
    subject, readings = ImuConsistency(RATE, STD), noise(6.0)
    readings[:, 2] += 0.2  # 2 % of gravity
    found = [subject.update(tuple(each), at_rest=number < SECOND) for number, each in enumerate(readings.tolist())]
    assert max(found[SECOND:]) < CONTRADICTION
    assert largest(readings) > CONTRADICTION


def test_not_a_number_is_no_agreement() -> None:
    subject = ImuConsistency(RATE, STD)
    for _ in range(10):
        found = subject.update((0.0, float("nan"), 0.0))
    assert not found <= CONTRADICTION


def test_reset_forgets() -> None:
    subject = ImuConsistency(RATE, STD)
    for _ in range(SECOND):
        subject.update((1.0, 1.0, 1.0))
    subject.reset()
    assert subject.update((0.0, 0.0, 0.0)) == 0.0
