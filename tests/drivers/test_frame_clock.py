"""Time stamps of frames while the wall clock is stepped and slewed: no cycle is lost, and time never goes back."""

from __future__ import annotations

import time
from collections.abc import Callable
from itertools import pairwise
from types import SimpleNamespace

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from upright.drivers.bus import socketcan
from upright.drivers.bus.frame_clock import STEP, FrameClock
from upright.drivers.bus.message_port import converted
from upright.telemetry.samples import CanFrame

MS, S = 1_000_000, 1_000_000_000
PERIOD = 4 * MS
EPOCH = 1_800_000_000 * S
"""Wall clock when the monotonic clock is 0."""


def received(
    wall: Callable[[int], int], seconds: float, latency: Callable[[int], int] = lambda number: 200_000
) -> tuple[FrameClock, list[tuple[int, int]]]:
    """Frames every 4 ms, read `latency` ns later at the latest: (true time, converted stamp) of each. `wall` gives the
    wall clock at a monotonic time."""
    clock = FrameClock(EPOCH)
    clock.read(wall(0), 0)
    found: list[tuple[int, int]] = []
    waiting: list[int] = []
    for number in range(1, round(seconds * S / PERIOD)):
        waiting.append(number * PERIOD)
        now = number * PERIOD + latency(number)
        if now >= (number + 1) * PERIOD:
            continue  # the process is held up, and reads these frames with the next ones
        clock.read(wall(now), now)
        for moment in waiting:
            stamp = wall(moment)
            found.append((moment + EPOCH, clock.convert(stamp) if clock.stepping else stamp + clock.shift_ns))
        waiting = []
    return clock, found


def stepped(at: int, by: int) -> Callable[[int], int]:
    return lambda time: EPOCH + time + (by if time >= at else 0)


def assert_nothing_is_lost(found: list[tuple[int, int]], error: int) -> None:
    assert max(abs(converted - true) for true, converted in found) <= error
    intervals = [later - earlier for (_, earlier), (_, later) in pairwise(found)]
    assert min(intervals) > 0
    assert max(intervals) <= 1.5 * PERIOD


def test_stamps_are_those_of_the_kernel_while_nobody_sets_the_clock() -> None:
    noise = [0, 3_000, 45_000, 1_000]
    clock, found = received(lambda time: EPOCH + time + noise[time // MS % 4], 2.0)
    assert all(abs(converted - true) == noise[(true - EPOCH) // MS % 4] for true, converted in found)
    assert clock.shift_ns == clock.steps == 0


@pytest.mark.parametrize("by", [20 * MS, 3600 * S, -S, -20 * MS, -3600 * S, 5 * MS])
@pytest.mark.parametrize("at", [S, S + MS, S + 100_000, S - 1])
def test_step_is_counted_and_nothing_else(by: int, at: int) -> None:
    clock, found = received(stepped(at, by), 2.0)
    assert_nothing_is_lost(found, error=0)
    assert clock.status() == {"steps": 1, "last_step": pytest.approx(by * 1e-9)}


@pytest.mark.parametrize("by", [20 * MS, 3600 * S, -S])
def test_step_while_the_process_is_held_up(by: int) -> None:
    clock, found = received(stepped(S + 9 * MS, by), 2.0, lambda number: 5 * MS if 248 <= number < 254 else 100_000)
    assert clock.steps == 1
    assert_nothing_is_lost(found[:240], error=0)
    assert_nothing_is_lost(found[260:], error=0)
    assert all(later > earlier for (_, earlier), (_, later) in pairwise(found))


@pytest.mark.parametrize("ppm", [500, -500])
def test_slew_is_followed_without_a_step(ppm: int) -> None:
    clock, found = received(lambda time: EPOCH + time + time * ppm // 1_000_000, 60.0)
    assert clock.steps == 0
    assert_nothing_is_lost(found, error=600_000)


def test_several_steps_one_after_the_other() -> None:
    def wall(time: int) -> int:
        return (
            EPOCH + time + sum(by for at, by in ((S, 20 * MS), (S + 8 * MS, -S), (S + 50 * MS, 7 * MS)) if time >= at)
        )

    clock, found = received(wall, 2.0)
    assert clock.steps == 3
    assert_nothing_is_lost(found, error=0)


STEPS = st.integers(-7200 * S, 7200 * S) | st.integers(-2 * PERIOD, 2 * PERIOD)
MOMENTS = st.integers(0, 2 * S) | st.integers(PERIOD - 3 * MS, 2 * PERIOD)


@settings(deadline=None, max_examples=400)
@given(STEPS, MOMENTS, st.integers(1_000, STEP))
@example(by=2_500_001, at=PERIOD + 1, latency=1_000)
@example(by=STEP + 1, at=PERIOD + 1, latency=1_000)
def test_any_step_at_any_time_loses_no_cycle(by: int, at: int, latency: int) -> None:
    """A step is longer than frames wait to be read, so their times are exact; less than a step is corrected slowly."""
    _, found = received(stepped(at, by), 2.5, lambda number: latency)
    assert_nothing_is_lost(found, error=0 if abs(by) > STEP else abs(by))


@settings(deadline=None, max_examples=400)
@given(STEPS, MOMENTS, st.integers(STEP, PERIOD - 1))
def test_time_is_wrong_by_no_more_than_frames_wait_to_be_read(by: int, at: int, latency: int) -> None:
    _, found = received(stepped(at, by), 2.5, lambda number: latency)
    assert max(abs(converted - true) for true, converted in found) <= latency
    assert all(later >= earlier for (_, earlier), (_, later) in pairwise(found))


def test_port_corrects_a_step_of_the_wall_clock(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = socketcan.start_clock()
    first = CanFrame(time.time_ns(), 0x123, b"")
    assert converted([first], clock) == [first]
    forward = SimpleNamespace(monotonic_ns=time.monotonic_ns, time_ns=lambda: time.time_ns() + 3600 * S)
    monkeypatch.setattr(socketcan, "time", forward)
    for _ in range(5):  # this process may be held up between the two readings, which are not used then
        arrived = time.time_ns()
        (second,) = converted([CanFrame(arrived + 3600 * S, 0x123, b"")], clock)
        if clock.steps:
            break
    assert clock.steps == 1
    assert abs(second.timestamp_ns - arrived) < MS
