"""One definition of what is asked for. That what a diagnosis names is needed, tests/diagnosis/test_hidden_catalogue.py
asks."""

from __future__ import annotations

import math

import numpy as np
import pytest

from diagnosis.evidence import LEVEL, ODDS, beyond_chance, is_supported, likelier


def test_chance_alone_is_as_rare_as_said() -> None:
    """Of 20,000 records, in which four parameters explain white noise, no more than chance gives of LEVEL."""
    noise = np.random.default_rng(1).standard_normal((20_000, 4))
    beyond = sum(beyond_chance(gain, 4) for gain in 0.5 * np.sum(noise**2, axis=1))
    assert abs(beyond / len(noise) - LEVEL) < 4.0 * math.sqrt(LEVEL / len(noise))


def test_one_of_many_has_to_gain_more() -> None:
    assert beyond_chance(5.0, 1)
    assert not beyond_chance(5.0, 1, tries=30)
    assert beyond_chance(8.0, 1, tries=30)


def test_a_gain_alone_does_not_ask_for_an_effect_whose_size_is_that_of_noise() -> None:
    assert not is_supported(1000.0, 1, 1.9)
    assert is_supported(1000.0, 1, 2.1)


@pytest.mark.parametrize("tries", [1.0, 40.0])
def test_of_many_explanations_each_has_to_be_likelier_by_their_number(tries: float) -> None:
    assert not likelier(math.log(0.99 * ODDS * tries), tries)
    assert likelier(math.log(1.01 * ODDS * tries), tries)
