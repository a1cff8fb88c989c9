"""The control loop on a bus that somebody else sends on, with the virtual vehicle, in simulated time."""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import replace

import pytest
from closed_loop import ClosedLoop

from upright.drivers.cia402.states import State
from upright.drivers.foreign import QUIET_NS
from upright.service.control.cycle.operation import Mode
from upright.service.control.cycle.readiness import drive_states
from upright.simulation.bus.power_state import PowerState
from upright.telemetry.samples import CanFrame

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


class TestStatusword:
    """Bits of the statusword beside the state, in a drive that says Operation enabled."""

    @staticmethod
    def with_bits(closed: ClosedLoop, clear: int = 0, add: int = 0) -> None:
        """From now on the left gimbal reports its state with other bits."""
        servo = closed.plant_side.drives["gimbal_left"].servo
        true = servo._statusword
        servo._statusword = lambda: true() & ~clear | add  # type: ignore[method-assign]

    @pytest.mark.parametrize(
        ("bit", "code", "words"),
        [(0x10, "drive_no_voltage", "no torque"), (0x200, "drive_not_remote", "follow the bus")],
    )
    def test_without_torque_or_control_is_a_fault_in_one_cycle(self, bit: int, code: str, words: str) -> None:
        closed = upright()
        self.with_bits(closed, clear=bit)
        closed.advance(2 * closed.vehicle.period)  # the statusword of one cycle is judged in the next
        assert (closed.loop.mode, closed.loop.code) == (Mode.FAULT, code)
        assert "gimbal_left" in closed.loop.reason
        assert words in closed.loop.reason

    def test_warnings_are_reported_once_and_shown_and_end_nothing(self) -> None:
        closed = upright()
        self.with_bits(closed, add=0x0880)
        for _ in range(4):
            closed.advance(0.5)
            closed.loop.look_after_drives()
        assert closed.loop.mode is Mode.RUNNING
        events = [text for _, code, text in closed.witness.events if code == "drive_warning"]
        assert events == ["drive gimbal_left: warning, internal limit active"]
        assert drive_states(closed.loop.io)[0]["warnings"] == ["warning", "internal limit active"]


class TestEmergency:
    def test_of_a_drive_that_goes_on_ends_the_experiment_in_order(self) -> None:
        closed = upright()
        closed._inbox.append(CanFrame(closed.plant_side.time_ns, 0x081, struct.pack("<HB5x", 0xFF01, 0x81)))
        closed.until(lambda: closed.loop.mode is not Mode.RUNNING, 30.0)
        assert (closed.loop.mode, closed.loop.code) == (Mode.DISARMED, "drive_warning")
        assert "gimbal_left warns: FF01h" in closed.loop.reason
        assert "FF01h" in closed.loop.interlocks()[0], "its cause is to be removed first"

    @pytest.mark.parametrize("code", [0x8130, 0x8250])
    def test_of_communication_stops_at_once(self, code: int) -> None:
        closed = upright()
        closed._inbox.append(CanFrame(closed.plant_side.time_ns, 0x081, struct.pack("<HB5x", code, 0x11)))
        closed.advance(closed.vehicle.period)
        assert (closed.loop.mode, closed.loop.code) == (Mode.FAULT, "drive_emergency")


class TestHeartbeatOfADrive:
    @staticmethod
    def sending(faults: tuple[str, ...] = ()) -> ClosedLoop:
        """A vehicle whose drives send heartbeats, as after their set-up."""
        closed = ClosedLoop(faults=faults)
        period = round(closed.vehicle.control.heartbeat_period * 1e3)
        for drive in closed.vehicle.drive:
            closed.plant_side.receive(0x600 + drive.node, b"\x2b\x17\x10\x00" + struct.pack("<I", period))
        closed.advance(1.0)
        return closed

    def test_that_stops_is_noticed_in_its_time_and_ends_the_experiment_in_order(self) -> None:
        closed = upright(self.sending())
        closed.plant_side.drives["trim"].heartbeat_enabled = False
        closed.advance(0.1)
        assert closed.loop.run is not None
        assert closed.loop.run.end_reason == ""
        closed.advance(0.09)
        assert "drive trim has sent no heartbeat" in closed.loop.run.end_reason
        closed.until(lambda: closed.loop.mode is not Mode.RUNNING, 30.0)
        assert (closed.loop.mode, closed.loop.code) == (Mode.DISARMED, "drive_heartbeat")
        assert "no heartbeat" in closed.loop.interlocks()[0]

    def test_is_missed_by_nobody_while_it_comes(self) -> None:
        closed = self.sending()
        closed.run("hold")
        assert (closed.loop.mode, closed.loop.reason) == (Mode.DISARMED, "")


def test_sdo_request_of_somebody_else_ends_the_experiment_in_order() -> None:
    closed = upright()
    closed.loop.on_frames([CanFrame(closed.plant_side.time_ns, 0x602, b"\x40\x41\x60\x00" + bytes(4))])
    closed.until(lambda: closed.loop.mode is not Mode.RUNNING, 30.0)
    assert (closed.loop.mode, closed.loop.code) == (Mode.DISARMED, "foreign_sdo")
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


class TestVerifiedStop:
    """Drives that do not do what they are told when the vehicle is stopped."""

    @staticmethod
    def supervised(**changes: object) -> ClosedLoop:
        """A vehicle whose drives watch the heartbeat, as after their set-up: they brake if it is missing."""
        closed = ClosedLoop(**changes)  # type: ignore[arg-type]
        timeout = round(closed.vehicle.control.heartbeat_timeout * 1e3)
        for drive in closed.vehicle.drive:
            node = closed.vehicle.control.master_node
            closed.plant_side.receive(0x600 + drive.node, b"\x23\x16\x10\x01" + struct.pack("<I", node << 16 | timeout))
            closed.plant_side.receive(0x600 + drive.node, b"\x2b\x07\x60\x00" + struct.pack("<I", 3))
        closed.advance(0.5)
        return upright(closed)

    @staticmethod
    def deaf_to_controlwords(closed: ClosedLoop) -> None:
        """The trim drive has its enabling controlword for ever."""
        servo = closed.plant_side.drives["trim"].servo
        write = servo.write
        servo.write = lambda key, value, now: write(key, 0x7F if key == 0x604000 else value, now)  # type: ignore[method-assign]

    @staticmethod
    def heartbeats(closed: ClosedLoop) -> int:
        return sum(frame.can_id == 0x77F for frame in closed.raw)

    def test_of_obedient_drives_withholds_nothing(self) -> None:
        closed = self.supervised()
        before = self.heartbeats(closed)
        closed.loop.stop_now("test")
        closed.advance(4.0)
        assert self.heartbeats(closed) - before == pytest.approx(200, abs=4)
        assert [code for _, code, _ in closed.witness.events] == ["operator"]
        assert all(drive.emergency is None for drive in closed.loop.io.drives)

    def test_withholds_the_heartbeat_until_a_deaf_drive_stops_by_itself(self) -> None:
        closed = self.supervised()
        self.deaf_to_controlwords(closed)
        closed.loop.stop_now("test")
        closed.advance(1.0)
        assert not off(closed)
        closed.advance(1.5)
        assert off(closed)
        assert closed.loop.reason == "test; not confirmed to be off, check by hand: trim"
        before = self.heartbeats(closed)
        closed.advance(1.0)
        assert self.heartbeats(closed) > before, "it is withheld no longer than a drive waits for it"

    @pytest.mark.parametrize("running", [True, False])
    def test_that_fails_is_said_before_anything_else(self, running: bool) -> None:
        closed = self.supervised()
        self.deaf_to_controlwords(closed)
        trim = closed.plant_side.drives["trim"]
        trim._connection_lost = lambda code: None  # type: ignore[method-assign]  # nor does it miss its master
        if running:
            closed.loop.stop_now("a limit was reached", "roll")
        else:
            closed.loop.end_experiment("changed my mind")
            closed.until(lambda: closed.loop.mode is not Mode.RUNNING, 30.0)
        fault = closed.loop.fault
        closed.advance(1.5)
        assert (closed.loop.mode, closed.loop.code) == (Mode.FAULT, "drive_still_enabled")
        assert closed.loop.reason.startswith("STILL ENABLED: drive trim (node 3)")
        assert closed.loop.state()["faults"][0]["text"] == closed.loop.reason
        assert closed.witness.events[-1][:2] == ("error", "drive_still_enabled")
        if running:
            assert closed.loop.reason.endswith("Stopped because: a limit was reached")
            assert fault is closed.loop.fault, "who has asked for the experiment is told, too"

    def test_keeps_the_next_experiment_waiting(self) -> None:
        closed = self.supervised()
        self.deaf_to_controlwords(closed)
        closed.loop.end_experiment("changed my mind")
        said = []
        for _ in range(3000):
            closed.advance(closed.vehicle.period)
            said += closed.loop.interlocks()
            if closed.loop.stopping and said[-1].endswith("has not confirmed that it is off."):
                break
        assert "missing heartbeat" in said[-1]

    def test_of_a_drive_that_does_not_answer_is_not_confirmed(self) -> None:
        closed = self.supervised()
        closed.plant_side.drives["trim"].connected = False
        closed.advance(4.0)
        assert closed.loop.code == "drive_silent"
        assert closed.witness.events[-1][1:] == (
            "drive_unconfirmed",
            "not confirmed to be off, check by hand: trim",
        )

    def test_ends_with_the_set_up_which_finds_the_drives_off(self) -> None:
        closed = self.supervised()
        closed.plant_side.drives["trim"].connected = False
        closed.advance(1.0)
        closed.loop.set_up_done()
        closed.advance(3.0)
        assert "drive_unconfirmed" not in [code for _, code, _ in closed.witness.events]


def test_time_stamps_that_stand_still_are_a_fault_of_their_own() -> None:
    closed = upright()
    deliver, frozen_ns = closed.loop.on_frames, closed.plant_side.time_ns
    closed.loop.on_frames = lambda frames: deliver([replace(frame, timestamp_ns=frozen_ns) for frame in frames])  # type: ignore[method-assign]
    closed.advance(7 * closed.vehicle.period)
    assert closed.loop.mode is Mode.RUNNING
    closed.advance(3 * closed.vehicle.period)
    assert (closed.loop.mode, closed.loop.code) == (Mode.FAULT, "imu_time")
