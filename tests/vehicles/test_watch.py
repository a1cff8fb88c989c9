"""What robot and cube watch of their own motion: the robot's axle, and the cube's wheel."""

from __future__ import annotations

import math
from functools import cache

import pytest

from upright.service.virtual.run import ClosedLoop
from upright.vehicles.contract import Lean
from upright.vehicles.cube.axes import WheelMeasurement
from upright.vehicles.cube.watch import CubeWatch
from upright.vehicles.file import load
from upright.vehicles.twsbr.axes import NOTHING_MEASURED
from upright.vehicles.twsbr.axes import WheelMeasurement as Wheels
from upright.vehicles.twsbr.watch import TwsbrWatch
from upright.vehicles.watch import GyroJumps

CUBE = load("cube")
DT = CUBE.period


@cache
def cube() -> CubeWatch:
    watch = ClosedLoop(CUBE).loop.kind.watch
    assert isinstance(watch, CubeWatch)
    return watch


def turned(torque: float, share: float, seconds: float = 0.2) -> float:
    """How far the wheel is from what its torque makes it, if only a share of the torque acts."""
    watch, inertia = cube(), CUBE.parameters.wheel_inertia.value
    watch.reset()
    watch._drive.setpoint = torque
    rate = 0.0
    for _ in range(round(seconds / DT)):
        watch.update(DT, Lean(0.0, 0.0), WheelMeasurement(1, 0.0, rate))
        rate += share * torque / inertia * DT
    return watch.wheel_following


def test_wheel_that_turns_as_its_torque_makes_it_is_no_fault() -> None:
    for share in (0.85, 1.0, 1.15):
        assert turned(0.03, share) == 0.0


@pytest.mark.parametrize("share", [0.0, 0.3, -1.0, 2.0])
def test_wheel_that_does_not_is_found_by_the_rate_that_is_missing(share: float) -> None:
    assert turned(0.03, share) > 0.005 * CUBE.limits.wheel_rate


def test_axle_accelerates_by_its_wheels_and_explains_the_sample_before() -> None:
    watch, still = TwsbrWatch(0.05), (0.0, 0.0, 0.0)
    lean = Lean(math.radians(10.0), 1.0)
    watch.update(0.005, lean, NOTHING_MEASURED)
    assert watch.unexplained((1.0, 2.0, 3.0)) == still
    watch.update(0.005, lean, Wheels(1, 0.0, 0.0, 3.0, 5.0, 0.0))
    assert watch.unexplained(still) == (1.0, 2.0, 3.0)
    watch.update(0.01, lean, Wheels(1, 0.0, 0.0, 5.0, 7.0, 0.0))
    forward, aside, up = watch.unexplained(still)
    assert math.hypot(forward, up) == pytest.approx(0.05 * 2.0 / 0.01)
    assert (aside, up / forward) == (0.0, pytest.approx(math.tan(lean.angle)))
    watch.reset()
    assert watch.unexplained(still) == still


def test_change_that_can_be_is_no_jump() -> None:
    jumps = GyroJumps(10.0, 0.004)
    rates = [0.0, 0.04, 0.08, 0.5, 0.5]
    changes = [jumps.update(rate) for rate in rates]
    assert changes == pytest.approx([0.0, 0.04, 0.04, 0.05, 0.0])
    assert jumps.jump == pytest.approx(0.37)
