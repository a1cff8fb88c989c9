"""The sequential test of lost cycles, on simulated losses."""

from __future__ import annotations

import random

import pytest

from estimators.loss_test import SURE, USUAL, LossTest


def cycles_until_sure(share: float, cycles: int, seed: int) -> int | None:
    draw, test = random.Random(seed), LossTest()
    for cycle in range(cycles):
        if draw.random() < share:
            test.lost()
        else:
            test.came()
        if test.evidence > SURE:
            return cycle
    return None


@pytest.mark.parametrize(("share", "mean"), [(0.5, 32.0), (2 / 3, 20.0), (1.0, 9.5)])
def test_heavy_losses_are_found_within_some_cycles(share: float, mean: float) -> None:
    found = [cycles_until_sure(share, 1000, seed) for seed in range(200)]
    assert sum(cycle for cycle in found if cycle is not None) / len(found) < mean
    assert None not in found


def test_usual_losses_are_not() -> None:
    assert cycles_until_sure(USUAL, 300_000, 1) is None


def test_missed_cycles_count_as_lost_ones() -> None:
    one, other = LossTest(), LossTest()
    one.came(missed=2)
    other.lost()
    other.lost()
    other.came()
    assert one.evidence == other.evidence > 0.0
    one.reset()
    assert one.evidence == 0.0
