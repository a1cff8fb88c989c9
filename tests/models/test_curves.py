"""The curve through the samples of a measured channel."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.interpolate import CubicHermiteSpline

from models.compiler.curves import read


def test_it_is_hermites_with_the_slopes_of_parabolas() -> None:
    """Which NumPy's gradient gives at instants that do not come at equal intervals."""
    source = np.random.default_rng(3)
    knots, values = np.sort(source.uniform(0.0, 1.0, 30)), source.normal(size=30)
    time = np.linspace(knots[0], knots[-1], 999)
    expected = CubicHermiteSpline(knots, values, np.gradient(values, knots))(time)
    assert read(time, knots, values) == pytest.approx(expected, rel=1e-12, abs=1e-12 * np.max(np.abs(expected)))


def test_at_a_sample_it_is_the_sample_to_the_last_bit() -> None:
    source = np.random.default_rng(5)
    knots, values = np.sort(source.uniform(0.0, 1.0, 30)), source.normal(size=30)
    assert np.array_equal(read(knots, knots, values), values)
    assert read(np.array([-1.0, 7.0]), knots, values).tolist() == [values[0], values[-1]]


@pytest.mark.parametrize("before", [0.1, 0.25, 0.5, 0.8])
def test_what_moves_smoothly_loses_next_to_nothing_between_samples(before: float) -> None:
    """A sine of 4 Hz at 250 a second; a straight line would be off by (w h)^2 / 8 of it in the middle, 1.3e-3."""
    w, knots = 2.0 * np.pi * 4.0, 0.004 * np.arange(1000)
    time = knots[2:-2] + 0.004 * before
    # The slopes at both ends err by (w h)^2 / 6, which cancels in the middle; of the fourth order 3 / 128 are left.
    turn = w * 0.004
    third, fourth = turn**3 / 6.0 * before * (1.0 - before) * abs(1.0 - 2.0 * before), turn**4 * 3.0 / 128.0
    assert np.max(np.abs(read(time, knots, np.sin(w * knots)) - np.sin(w * time))) < third + 1.01 * fourth


def test_next_to_what_is_not_known_it_is_known_up_to_the_last_sample() -> None:
    knots = np.arange(8.0)
    values = 2.0 * knots
    values[4] = np.nan
    time = np.array([0.5, 2.7, 3.0, 3.001, 4.0, 4.9, 5.0, 5.5])
    expected = [1.0, 5.4, 6.0, np.nan, np.nan, np.nan, 10.0, 11.0]
    assert read(time, knots, values) == pytest.approx(expected, nan_ok=True)


def test_one_sample_alone_is_all_there_is() -> None:
    assert read(np.array([0.0, 3.0]), np.array([1.0]), np.array([7.0])).tolist() == [7.0, 7.0]
