"""The control loop on a bus that somebody else sends on, with the virtual vehicle, in simulated time."""

from __future__ import annotations

import struct
from collections.abc import Callable

import pytest
from closed_loop import ClosedLoop

from drivers.cia402.states import State
from drivers.foreign import QUIET_NS
from service.control.loop import Mode
from simulation.bus.power_state import PowerState
from telemetry.samples import CanFrame

ENABLED_AT_300_RPM = struct.pack("<Hhh", 0x7F, 300, 0)
FOREIGN = {
    "setpoints": (0x201, ENABLED_AT_300_RPM, "201h, setpoints (RPDO 1) of drive gimbal_left (node 1)"),
    "sync": (0x080, b"", "080h, the SYNC"),
    "heartbeat": (0x77F, b"\x05", "77Fh, the master's heartbeat (node 127)"),
    "nmt": (0x000, b"\x80\x02", "000h, an NMT command (pre operational, node 2)"),
}


def upright(vehicle: ClosedLoop | None = None) -> ClosedLoop:
    closed = vehicle or ClosedLoop()
    assert closed.loop.interlocks() == []
    closed.loop.start_experiment("hold")
    closed.advance(10.0)
    assert closed.loop.mode is Mode.RUNNING
    return closed


def somebody_sends(closed: ClosedLoop, can_id: int, data: bytes) -> None:
    """A frame from another node: it reaches the service and the drives."""
    closed._inbox.append(CanFrame(closed.plant_side.time_ns, can_id, data))
    closed.plant_side.receive(can_id, data)


def every_cycle(closed: ClosedLoop, seconds: float, act: Callable[[], None]) -> None:
    for _ in range(round(seconds / closed.vehicle.period)):
        act()
        closed.advance(closed.vehicle.period)


def off(closed: ClosedLoop) -> bool:
    """Whether no drive has torque, in truth."""
    powered = {PowerState.OPERATION_ENABLED, PowerState.QUICK_STOP_ACTIVE, PowerState.FAULT_REACTION_ACTIVE}
    return not any(drive.state in powered for drive in closed.plant_side.drives.values())


class TestForeignMaster:
    @pytest.mark.parametrize("kind", FOREIGN)
    def test_during_an_experiment_is_a_fault_in_the_same_cycle(self, kind: str) -> None:
        closed = upright()
        can_id, data, words = FOREIGN[kind]
        somebody_sends(closed, can_id, data)
        closed.advance(closed.vehicle.period)
        assert (closed.loop.mode, closed.loop.code) == (Mode.FAULT, "foreign_master")
        assert words in closed.loop.reason
        assert "disconnect" in closed.loop.reason
        closed.advance(2.0)
        assert off(closed)

    def test_that_goes_on_commanding_moves_nothing(self) -> None:
        """It sends setpoints after ours, in every cycle: only NMT stop takes the drives out of its hands."""
        closed = upright()

        def interfere() -> None:
            for node in (1, 2):
                somebody_sends(closed, 0x200 + node, ENABLED_AT_300_RPM)

        every_cycle(closed, 2.0, interfere)
        assert off(closed)
        sent = [frame for frame in closed.raw[-4000:] if frame.can_id in (0x000, 0x77F)]
        stopped_from = next(i for i, frame in enumerate(sent) if frame.data == b"\x02\x01")
        assert {frame.can_id for frame in sent[stopped_from:]} == {0x000}, "a heartbeat after the stop"
        assert abs(closed.plant_side.plant.precession_rate) < 1e-3

    def test_does_not_change_what_was_sent(self) -> None:
        closed = ClosedLoop()
        drive = closed.loop.io.drives[0]
        before = drive.controlword, drive.setpoint
        closed.loop.on_frames([CanFrame(closed.plant_side.time_ns, 0x201, ENABLED_AT_300_RPM)])
        assert (drive.controlword, drive.setpoint) == before

    def test_cannot_be_reset_while_it_sends(self) -> None:
        closed = upright()
        somebody_sends(closed, *FOREIGN["setpoints"][:2])
        closed.advance(2.0)
        assert "201h" in closed.loop.reset_fault()
        closed.advance(QUIET_NS * 1e-9)
        assert closed.loop.reset_fault() == ""
        assert not closed.loop.cut_off

    @pytest.mark.parametrize("kind", FOREIGN)
    def test_before_an_experiment_is_an_interlock_that_ends_with_it(self, kind: str) -> None:
        closed = ClosedLoop()
        can_id, data, words = FOREIGN[kind]
        for _ in range(3):
            closed.loop.on_frames([CanFrame(closed.plant_side.time_ns, can_id, data)])
        closed.advance(0.5)
        (interlock,) = closed.loop.interlocks()
        assert words in interlock
        assert interlock.endswith(".")
        assert closed.loop.foreign.statistics()[0]["frames"] == 3
        closed.advance(QUIET_NS * 1e-9)
        closed.loop.start_experiment("hold")
        closed.advance(1.0)
        assert closed.loop.mode is Mode.RUNNING

    def test_on_the_bus_of_the_imu_alone_is_none(self) -> None:
        closed = upright()
        closed.loop.on_frames([CanFrame(closed.plant_side.time_ns, 0x201, ENABLED_AT_300_RPM, 1)])
        closed.advance(1.0)
        assert closed.loop.mode is Mode.RUNNING


def test_sdo_request_of_somebody_else_ends_the_experiment_in_order() -> None:
    closed = upright()
    closed.loop.on_frames([CanFrame(closed.plant_side.time_ns, 0x602, b"\x40\x41\x60\x00" + bytes(4))])
    closed.until(lambda: closed.loop.mode is not Mode.RUNNING, 30.0)
    assert closed.loop.mode is Mode.DISARMED
    assert "602h, an SDO request to drive gimbal_right (node 2)" in closed.loop.reason
    assert closed.loop.io.state is State.SWITCH_ON_DISABLED


@pytest.mark.parametrize("copied", ["frames", "sets"])
def test_everything_twice_changes_nothing(copied: str) -> None:
    closed = ClosedLoop()
    deliver = closed.loop.on_frames

    def twice(frames: list[CanFrame]) -> None:
        deliver(frames + frames if copied == "sets" else [frame for frame in frames for _ in range(2)])

    closed.loop.on_frames = twice  # type: ignore[method-assign]
    missed = closed.loop.missed_cycles
    closed.run("hold")
    assert (closed.loop.mode, closed.loop.reason) == (Mode.DISARMED, "")
    assert closed.loop.missed_cycles == missed
    assert closed.loop.io.imu.statistics.duplicates > 3 * 1000
