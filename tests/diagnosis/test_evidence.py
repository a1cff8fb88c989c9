"""One definition of when an effect is needed. tests/diagnosis/records/test_hidden_catalogue.py checks that the effects
which a diagnosis names are needed."""

from __future__ import annotations

import math

import numpy as np
import pytest

from upright.diagnosis.evidence import LEVEL, ODDS, beyond_chance, by_chance, is_supported, likelier


def test_false_alarm_rate_equals_the_level() -> None:
    """Of 20,000 records in which four parameters explain white noise, a share of LEVEL is called beyond chance."""
    noise = np.random.default_rng(1).standard_normal((20_000, 4))
    beyond = sum(beyond_chance(log_ratio, 4) for log_ratio in 0.5 * np.sum(noise**2, axis=1))
    assert abs(beyond / len(noise) - LEVEL) < 4.0 * math.sqrt(LEVEL / len(noise))


def test_a_shape_that_noise_chose_does_not_make_an_effect_evident() -> None:
    """The best of all frequencies in white noise: two amplitudes and a shape."""
    rows = 64
    noise = np.random.default_rng(2).standard_normal((5_000, rows))
    fitted = np.max(np.abs(np.fft.rfft(noise, 8 * rows)[:, 8:-8]) ** 2 / rows, axis=1)
    naive, bounded = (np.mean([by_chance(each, 3, shapes, rows) < LEVEL for each in fitted]) for shapes in (0, 1))
    assert naive > 10.0 * LEVEL
    assert bounded <= LEVEL
    assert by_chance(8.0 + math.log(rows), 3, 1, rows) < LEVEL


def test_best_of_many_effects_needs_a_higher_log_likelihood_ratio() -> None:
    assert beyond_chance(5.0, 1)
    assert not beyond_chance(5.0, 1, tries=30)
    assert beyond_chance(8.0, 1, tries=30)


def test_effect_with_an_insignificant_amplitude_is_not_supported() -> None:
    assert not is_supported(1000.0, 1, 1.9)
    assert is_supported(1000.0, 1, 2.1)


@pytest.mark.parametrize("tries", [1.0, 40.0])
def test_required_odds_grow_with_the_number_of_explanations(tries: float) -> None:
    assert not likelier(math.log(0.99 * ODDS * tries), tries)
    assert likelier(math.log(1.01 * ODDS * tries), tries)
