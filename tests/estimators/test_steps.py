"""Steps in a short series of estimates: found where they are, and not found where there is none."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from upright.estimators.steps import SHORTEST, likeliest, steps

Array = NDArray[np.float64]
RUNS = 200


def series(random: np.random.Generator, count: int, scatter: float, uneven: float) -> tuple[Array, Array]:
    """Values without a step, with standard deviations of about 1 that differ by a factor of exp(+-`uneven`)."""
    stds = np.exp(uneven * random.standard_normal(count))
    return random.standard_normal(count) * np.hypot(stds, scatter), stds


@pytest.mark.parametrize("count", [4, 8, 24])
@pytest.mark.parametrize("scatter", [0.0, 1.0, 3.0])
@pytest.mark.parametrize("uneven", [0.0, 1.0])
def test_false_alarms_are_not_more_frequent_than_their_level(count: int, scatter: float, uneven: float) -> None:
    """Three standard errors of a share of 5 % of RUNS are 4.6 %."""
    random = np.random.default_rng(3)
    alarms = [likeliest(*series(random, count, scatter, uneven))[1] < 0.05 for _ in range(RUNS)]
    assert np.mean(alarms) < 0.05 + 0.046


def test_false_alarms_of_many_series_are_those_of_one() -> None:
    """100 fleets of 10 series each, at 20 %: three standard errors are 12 %."""
    random = np.random.default_rng(5)
    fleets = [any(steps(*series(random, 8, 2.0, 0.3), level=0.2, tests=10) for _ in range(10)) for _ in range(100)]
    assert np.mean(fleets) < 0.2 + 0.12


@pytest.mark.parametrize("scatter", [0.0, 1.0])
def test_step_is_found_at_its_place_with_its_levels(scatter: float) -> None:
    random = np.random.default_rng(7)
    values, stds = series(random, 16, scatter, 0.3)
    values[9:] += 12.0
    (found,) = steps(values, stds, level=0.01, tests=100)
    assert found.place == 9
    assert found.p_value < 0.001
    for (mean, std), true in ((found.before, 0.0), (found.after, 12.0)):
        assert abs(mean - true) < 4.0 * std
        assert 0.1 < std < 1.5


def test_levels_deviate_as_they_say() -> None:
    """The difference of the levels has the standard deviation that they give, within three standard errors."""
    random = np.random.default_rng(11)
    off = []
    for _ in range(RUNS):
        values, stds = series(random, 12, 2.0, 0.3)
        values[6:] += 40.0
        (found,) = steps(values, stds, level=0.01)
        off.append((found.after[0] - found.before[0] - 40.0) / np.hypot(found.before[1], found.after[1]))
    assert np.std(off) == pytest.approx(1.0, abs=3.0 / np.sqrt(2.0 * RUNS) + 0.1)


def test_step_and_the_way_back_are_both_found() -> None:
    random = np.random.default_rng(13)
    values, stds = series(random, 30, 0.5, 0.0)
    values[10:20] += 15.0
    found = steps(values, stds, level=0.01)
    assert [each.place for each in found] == [10, 20]
    assert found[0].after == found[1].before


def test_single_outlier_and_a_series_too_short_are_no_step() -> None:
    values = np.array([0.0, 0.1, -0.1, 0.05, -0.05, 0.1, 0.0, 50.0])
    assert steps(values, np.full(8, 0.1), level=0.01) == ()
    assert steps(values[-SHORTEST + 1 :], np.full(SHORTEST - 1, 0.1), level=0.01) == ()


def test_result_does_not_depend_on_the_unit_or_on_the_size_of_a_block(monkeypatch: pytest.MonkeyPatch) -> None:
    values, stds = series(np.random.default_rng(17), 25, 1.0, 0.5)
    values[12:] += 6.0
    (metres,) = steps(values, stds, level=0.01)
    (nanometres,) = steps(1e9 * values, 1e9 * stds, level=0.01)
    assert (nanometres.place, nanometres.p_value) == (metres.place, pytest.approx(metres.p_value, rel=1e-6))
    monkeypatch.setattr("upright.estimators.steps.BLOCK", 60)
    assert steps(values, stds, level=0.01)[0] == metres


def test_imprecise_estimates_do_not_decide() -> None:
    """The step is in the three precise estimates on each side; the others could be anything."""
    random = np.random.default_rng(19)
    stds = np.array([0.1, 100.0, 0.1, 100.0, 0.1, 0.1, 100.0, 0.1, 100.0, 0.1])
    values = stds * random.standard_normal(10)
    values[5:] += 5.0
    (found,) = steps(values, stds, level=0.01)
    assert found.place in (5, 4)
    assert found.after[0] - found.before[0] == pytest.approx(5.0, abs=0.5)
