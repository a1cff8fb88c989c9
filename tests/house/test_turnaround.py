"""The turnaround benchmark's arithmetic: which reply answers which frame set, and what counts as missed."""

from __future__ import annotations

import runpy
from pathlib import Path
from typing import Any

import pytest

BENCHMARK: dict[str, Any] = runpy.run_path(str(Path(__file__).resolve().parents[2] / "benchmarks" / "turnaround.py"))

PERIOD_NS = 4_000_000


def test_frame_set_is_answered_by_the_first_reply_before_the_next_set() -> None:
    triggers = [PERIOD_NS * cycle for cycle in range(1, 7)]
    replies = [
        triggers[0] - 1_000,  # left over from before
        triggers[0] + 100_000,
        triggers[0] + 300_000,  # a second frame of the same answer
        triggers[1] + 200_000,
        # no reply to the third set; the fourth is answered only after the fifth, and that reply counts for the fifth
        triggers[4] + 50_000,
        triggers[5] + 1_000,  # the last set is not evaluated: its period is not over
    ]
    result = BENCHMARK["evaluate"]("daemon", 250.0, triggers, replies)
    assert (result.cycles, result.missed) == (5, 2)
    assert result.p50 == pytest.approx(100e-6)
    assert result.longest == pytest.approx(200e-6)


def test_responder_that_never_answers_is_named_in_the_error() -> None:
    with pytest.raises(BENCHMARK["ResponderError"], match="daemon answered no frame set"):
        BENCHMARK["evaluate"]("daemon", 250.0, [1, 2, 3], [])
