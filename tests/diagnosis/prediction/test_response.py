"""Gain and phase of a measured over a simulated signal, octave by octave."""

from __future__ import annotations

import numpy as np
import pytest

from upright.diagnosis.prediction.response import Band, responses
from upright.vehicles.experiment.excitation import Sweep

PERIOD, SECONDS = 0.004, 60.0
TIME = np.arange(0.0, SECONDS, PERIOD)
FADE = np.minimum(1.0, np.minimum(TIME, SECONDS - TIME))
SWEEP = FADE * np.array([Sweep(0.05, 2.0, SECONDS)(each) for each in TIME])


def measured(gain: float, delay: float, noise: float, seed: int) -> np.ndarray:
    random = np.random.default_rng(seed)
    return gain * np.interp(TIME - delay, TIME, SWEEP) + noise * random.standard_normal(len(TIME))


def bands(gain: float = 1.0, delay: float = 0.0, noise: float = 0.01, seed: int = 1) -> list[Band]:
    return responses([measured(gain, delay, noise, seed)], [SWEEP], PERIOD)


def test_the_same_signal_responds_as_itself() -> None:
    found = bands(noise=0.0)
    assert all(each.response == pytest.approx(1.0) for each in found)
    assert found[0].begin < 0.1
    assert 1.5 < found[-1].end < 5.0, "only what the sweep excites"


def test_gain_and_delay_are_found_within_their_deviations() -> None:
    for each in bands(gain=0.9, delay=0.02):
        middle = (each.begin * each.end) ** 0.5
        assert abs(each.response) == pytest.approx(0.9, abs=4.0 * each.std + 0.005)
        assert np.angle(each.response) == pytest.approx(-2.0 * np.pi * middle * 0.02, rel=0.4)


def test_noise_alone_is_seldom_unlikely() -> None:
    chances = np.array([each.chance for seed in range(40) for each in bands(noise=0.2, seed=seed)])
    assert np.mean(chances < 0.05) == pytest.approx(0.05, abs=0.035)


def test_parts_are_taken_together_and_short_ones_left_out() -> None:
    one = measured(0.8, 0.0, 0.01, 3)
    found = responses([one, one, one[:5]], [SWEEP, SWEEP, SWEEP[:5]], PERIOD)
    assert all(abs(each.response) == pytest.approx(0.8, abs=0.01) for each in found)
    assert responses([one[:5]], [SWEEP[:5]], PERIOD) == []
