"""The arithmetic of the soak: what counts as growth, and what as noise."""

from __future__ import annotations

import runpy
from pathlib import Path
from typing import Any

import numpy as np
import pytest

FOLDER = Path(__file__).resolve().parents[2] / "benchmarks"
AT = [30.0 * number for number in range(120)]
"""s: an experiment every 30 s for an hour."""


@pytest.fixture
def soak(monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    monkeypatch.syspath_prepend(str(FOLDER))
    return runpy.run_path(str(FOLDER / "soak.py"))


def test_leak_is_found_and_its_rate_is_right(soak: dict[str, Any]) -> None:
    noise = np.random.default_rng(1).normal(0.0, 0.3, len(AT))
    leak = [80.0 + 4.0 * at / 3600.0 for at in AT]
    found = soak["trend"]("control, MB", AT, leak + noise, soak["ARENA"])
    assert found.grows
    assert found.slope == pytest.approx(4.0, abs=3.0 * found.deviation)
    assert found.deviation < 0.3


def test_growth_at_the_beginning_and_noise_that_wanders_are_no_growth(soak: dict[str, Any]) -> None:
    start = [80.0 + min(at / 600.0, 1.0) for at in AT]
    assert not soak["trend"]("control, MB", AT, start, soak["ARENA"]).grows
    alarms = 0
    for seed in range(50):
        steps = np.random.default_rng(seed).normal(0.0, 0.3, len(AT))
        wander = np.zeros(len(AT))
        for number in range(1, len(AT)):
            wander[number] = 0.5 * wander[number - 1] + steps[number]
        alarms += soak["trend"]("turnaround, us", AT, 300.0 + wander).grows
    assert alarms <= 1


def test_page_more_in_each_run_is_below_an_arena(soak: dict[str, Any]) -> None:
    at = AT[:6]
    assert not soak["trend"]("control, MB", at, [80.0 + 0.004 * number for number in range(6)], soak["ARENA"]).grows
    assert soak["trend"]("control, MB", at, [80.0 + 1.0 * number for number in range(6)], soak["ARENA"]).grows
