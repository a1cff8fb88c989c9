"""A vehicle whose drives are as slow as real ones is set up, and runs an experiment."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from upright.service.control.clients import api
from upright.service.control.cycle.operation import Mode
from upright.service.control.daemon import Places
from upright.service.virtual.daemon import daemon_beside
from upright.simulation.config import SimulationConfig
from upright.simulation.drive_habits import DriveHabits
from upright.vehicles.file import load

pytestmark = pytest.mark.patient

SLOW = DriveHabits(answer_time=0.35, boot_time=2.0, store_time=0.1, mode_time=4.0)


def slow(config: SimulationConfig) -> SimulationConfig:
    return replace(config, drives=tuple(replace(drive, habits=SLOW) for drive in config.drives))


def until(what: Callable[[], bool], seconds: float) -> None:
    limit = time.monotonic() + seconds
    while not what():
        assert time.monotonic() < limit, "not in time"
        time.sleep(0.01)


def test_vehicle_with_slow_drives_is_set_up_and_runs(tmp_path: Path) -> None:
    bus, socket = "virtual:slow", tmp_path / "s.sock"
    with daemon_beside(load("monocab"), Places(bus, bus, tmp_path, socket), [], 3, configure=slow) as daemon:
        until(lambda: daemon.loop.mode is Mode.DISARMED and not daemon.loop.interlocks(), 60.0)
        assert [report.warnings for report in daemon.reports] == [()] * len(daemon.loop.io.drives)
        *_, last = api.call([socket], {"verb": "experiment", "name": "step"}, timeout=60.0)
    assert (last["exit_code"], last["failure"]) == (0, "")
