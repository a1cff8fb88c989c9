"""The sequential test of lost cycles, on simulated losses."""

from __future__ import annotations

import random

import pytest

from upright.estimators.checks.loss_test import THRESHOLD, USUAL, LossTest


def cycles_until_sure(share: float, cycles: int, seed: int) -> int | None:
    draw, test = random.Random(seed), LossTest()
    for cycle in range(cycles):
        if draw.random() < share:
            test.lost()
        else:
            test.came()
        if test.log_ratio > THRESHOLD:
            return cycle
    return None


@pytest.mark.parametrize(("share", "mean"), [(0.5, 40.0), (2 / 3, 30.0), (0.75, 30.0)])
def test_heavy_losses_are_found_within_some_cycles(share: float, mean: float) -> None:
    found = [cycles_until_sure(share, 1000, seed) for seed in range(200)]
    assert sum(cycle for cycle in found if cycle is not None) / len(found) < mean
    assert None not in found


def test_interruption_is_one_event_unless_it_is_to_count_as_a_whole() -> None:
    one, whole = LossTest(), LossTest(in_a_row=100)
    for _ in range(50):
        one.lost()
        whole.lost()
    other = LossTest()
    other.came(missed=50)
    assert other.log_ratio < one.log_ratio < THRESHOLD / 2 < THRESHOLD < whole.log_ratio


def test_usual_losses_are_not() -> None:
    assert cycles_until_sure(USUAL, 300_000, 1) is None


def test_missed_cycles_count_as_lost_ones() -> None:
    one, other = LossTest(), LossTest()
    one.came(missed=2)
    other.lost()
    other.lost()
    other.came()
    assert one.log_ratio == other.log_ratio > 0.0
    one.reset()
    assert one.log_ratio == 0.0


def test_cycles_that_come_bunched_were_late_and_not_lost() -> None:
    test = LossTest()
    for _ in range(200):
        test.came(missed=2)
        test.came(missed=-1)
        test.came(missed=-1)
    assert test.log_ratio < THRESHOLD / 10


def test_early_cycles_do_not_make_up_for_losses_before() -> None:
    test, other = LossTest(), LossTest()
    for each in (test, other):
        each.came(missed=3)
        each.came()
    test.came(missed=-1)
    assert test.log_ratio == other.log_ratio > 0.0


def test_answers_that_come_a_cycle_late_are_not_lost() -> None:
    test = LossTest()
    for _ in range(500):
        test.lost()
        test.came()
        test.came(missed=-1)
    assert test.log_ratio < THRESHOLD / 5
