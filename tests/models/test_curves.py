"""Interpolation between the samples of a measured channel."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.interpolate import CubicHermiteSpline

from upright.models.compiler.curves import read


def test_curve_is_cubic_hermite_with_the_slopes_of_parabolas() -> None:
    """NumPy's gradient gives these slopes for unequally spaced samples, too."""
    source = np.random.default_rng(3)
    knots, values = np.sort(source.uniform(0.0, 1.0, 30)), source.normal(size=30)
    time = np.linspace(knots[0], knots[-1], 999)
    expected = CubicHermiteSpline(knots, values, np.gradient(values, knots))(time)
    assert read(time, knots, values) == pytest.approx(expected, rel=1e-12, abs=1e-12 * np.max(np.abs(expected)))


def test_curve_equals_the_samples_exactly_and_is_constant_beyond() -> None:
    source = np.random.default_rng(5)
    knots, values = np.sort(source.uniform(0.0, 1.0, 30)), source.normal(size=30)
    assert np.array_equal(read(knots, knots, values), values)
    assert read(np.array([-1.0, 7.0]), knots, values).tolist() == [values[0], values[-1]]


@pytest.mark.parametrize("before", [0.1, 0.25, 0.5, 0.8])
def test_smooth_motion_is_interpolated_with_third_order_error(before: float) -> None:
    """A 4 Hz sine sampled at 250 Hz; in the middle, linear interpolation would be off by (w h)^2 / 8, 1.3e-3."""
    w, knots = 2.0 * np.pi * 4.0, 0.004 * np.arange(1000)
    time = knots[2:-2] + 0.004 * before
    # The slopes at both ends err by (w h)^2 / 6, which cancels in the middle and leaves 3 / 128 of fourth order.
    turn = w * 0.004
    third, fourth = turn**3 / 6.0 * before * (1.0 - before) * abs(1.0 - 2.0 * before), turn**4 * 3.0 / 128.0
    assert np.max(np.abs(read(time, knots, np.sin(w * knots)) - np.sin(w * time))) < third + 1.01 * fourth


def test_curve_is_nan_only_between_a_missing_sample_and_its_neighbours() -> None:
    knots = np.arange(8.0)
    values = 2.0 * knots
    values[4] = np.nan
    time = np.array([0.5, 2.7, 3.0, 3.001, 4.0, 4.9, 5.0, 5.5])
    expected = [1.0, 5.4, 6.0, np.nan, np.nan, np.nan, 10.0, 11.0]
    assert read(time, knots, values) == pytest.approx(expected, nan_ok=True)


def test_single_sample_gives_a_constant() -> None:
    assert read(np.array([0.0, 3.0]), np.array([1.0]), np.array([7.0])).tolist() == [7.0, 7.0]
