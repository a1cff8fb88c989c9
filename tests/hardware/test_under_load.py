"""Short forms of the benchmarks that run the whole system on SocketCAN: hostile clients, and the soak."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

pytestmark = [pytest.mark.vcan, pytest.mark.timeout(600)]

FOLDER = Path(__file__).resolve().parents[2] / "benchmarks"


def run(program: str, *options: str) -> str:
    """The output of a benchmark that has to succeed."""
    command = [sys.executable, str(FOLDER / program), *options]
    done = subprocess.run(command, capture_output=True, text=True, cwd=FOLDER.parent, check=False)
    sys.stderr.write(done.stdout + done.stderr)
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-2000:]
    return done.stdout


def test_hostile_clients_neither_delay_the_control_loop_nor_end_an_experiment() -> None:
    """The lease holds and a stop gets through. The ratio of p99.9 needs more cycles than there is time for here, and a
    computer with nothing else to do: docs/measurements/load.md has it."""
    options = ("--kind", "all", "--rounds", "3", "--seconds", "3", "--json")
    found: dict[str, Any] = json.loads(run("clients.py", *options))
    (row,) = found["rows"]
    assert row["ratios"]["p50"] < 1.5
    assert row["with"]["missed"] <= row["without"]["missed"] + 0.01 * row["with"]["cycles"]
    assert found["clients"]["refused"] > 100, "the clients were there"


def test_short_soak_shows_no_growth_and_no_missed_heartbeat() -> None:
    """An hour is what docs/measurements/load.md shows; this finds what grows fast, and that the soak works."""
    options = ("--minutes", "1", "--experiment", "step", "--experiment", "hold", "--duration", "1")
    assert "Nothing grows" in run("soak.py", *options)
