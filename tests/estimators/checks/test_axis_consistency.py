"""Position and rate of an axis: resolution, filter and scale are no contradiction, a frozen encoder is."""

from __future__ import annotations

import math
from collections.abc import Callable

import pytest

from upright.estimators.checks.axis_consistency import AxisConsistency

DT = 0.004
LAG = 0.002
COUNT = 2.0 * math.pi / 700.0


def largest(position: Callable[[float], float], rate: Callable[[float], float], seconds: float = 10.0) -> float:
    axis = AxisConsistency()
    times = (DT * number for number in range(round(seconds / DT)))
    return max(axis.update(DT, DT, position(time), rate(time)) for time in times)


def angle(time: float) -> float:
    return 2.0 * math.sin(3.0 * time)


def speed(time: float) -> float:
    return 6.0 * math.cos(3.0 * time)


def test_healthy_axis_differs_by_resolution_and_filter() -> None:
    counted = largest(lambda time: COUNT * round(angle(time) / COUNT), lambda time: speed(time - LAG))
    assert counted < 6.0 * LAG + 2.0 * COUNT


def test_error_of_scale_is_forgiven() -> None:
    assert largest(angle, lambda time: 1.09 * speed(time)) < 0.05


@pytest.mark.parametrize("frozen", ["position", "rate"])
def test_frozen_encoder_is_found_by_the_way_that_it_does_not_show(frozen: str) -> None:
    still = angle(0.0), speed(0.0)
    position = (lambda time: still[0]) if frozen == "position" else angle
    rate = (lambda time: still[1]) if frozen == "rate" else speed
    assert largest(position, rate, 0.8) > 0.4


def test_values_that_are_missing_begin_again() -> None:
    axis = AxisConsistency()
    assert axis.update(DT, DT, math.nan, math.nan) == 0.0
    assert axis.update(DT, DT, 5.0, 0.0) == 0.0
    assert axis.update(DT, DT, 6.0, 0.0) == pytest.approx(1.0)
    assert axis.update(DT, DT, math.nan, 0.0) == 0.0
    assert axis.update(DT, DT, 6.0, 0.0) == 0.0


def test_interval_that_is_not_a_period_says_nothing() -> None:
    axis = AxisConsistency()
    steps = ((DT, 0.0), (DT, 0.004), (0.04, 0.008), (-0.032, 0.012), (DT, 0.016), (0.03, 5.0), (DT, 5.004))
    assert max(axis.update(dt, DT, place, 1.0) for dt, place in steps) < 1e-9
