"""The control loop against the virtual vehicle, in simulated time: every experiment, every way it can end."""

from __future__ import annotations

import math
from itertools import pairwise

import pytest
from closed_loop import ClosedLoop
from monocab_channels import MONOCAB
from thorough import of_many

from upright.drivers.cia402.states import State
from upright.drivers.foreign import SYNC_COB_ID
from upright.drivers.vehicle_io import VehicleIo
from upright.service.control import assembly
from upright.service.control.cycle import rows as rows_module
from upright.service.control.cycle.operation import Mode
from upright.service.control.cycle.rows import rows_from_frames
from upright.telemetry.samples import CanFrame
from upright.vehicles import registry
from upright.vehicles.experiment.phases import Phase
from upright.vehicles.file import VehicleFile, load

ROLL = MONOCAB.index_of("roll")
PRECESSION = MONOCAB.index_of("precession")
SETPOINT = MONOCAB.index_of("precession_rate_setpoint")
PHASE = MONOCAB.index_of("phase")


def at_rate(rate: int) -> VehicleFile:
    vehicle = load("monocab")
    return vehicle.model_copy(update={"control": vehicle.control.model_copy(update={"rate": rate})})


def assert_rests_disarmed(closed: ClosedLoop) -> None:
    closed.advance(1.0)
    assert closed.loop.io.state is State.SWITCH_ON_DISABLED
    assert closed.loop.lean is not None
    assert abs(closed.loop.lean.angle) == pytest.approx(closed.vehicle.support, abs=math.radians(0.3))
    assert abs(closed.loop.lean.rate) < 0.005


EXPERIMENTS = [name for name, each in load("monocab").experiments.items() if each.gets_up]
ON_SUPPORT = ("rest", "tilt", "drives", "silence")
LONG = ("sweep", "output_sweep", "full_sweep")
"""A minute each. The tests on a bus run them, too, for 20 and 30 s."""


@pytest.mark.parametrize("name", of_many(EXPERIMENTS, *(each for each in EXPERIMENTS if each not in LONG)))
def test_every_experiment_goes_from_rest_to_rest(name: str) -> None:
    closed = ClosedLoop()
    closed.run(name)
    assert closed.loop.mode is Mode.DISARMED
    assert closed.loop.reason == ""
    assert_rests_disarmed(closed)
    phases = {Phase(int(frame.values[PHASE])) for frame in closed.witness.frames}
    assert phases >= set(Phase) - {Phase.CENTRE, Phase.MOVE}
    upright = [frame.values for frame in closed.witness.frames if frame.values[PHASE] == Phase.EXCITE]
    assert max(abs(values[ROLL]) for values in upright) < math.radians(3.0)
    assert max(abs(values[PRECESSION]) for values in upright) < math.radians(
        closed.vehicle.limits.precession_budget_deg
    )


def course_of(closed: ClosedLoop) -> list[Phase]:
    """The phases of the last recording, in order."""
    phases = [Phase(int(frame.values[PHASE])) for frame in closed.witness.frames]
    return [phase for phase, before in zip(phases, [Phase.NONE, *phases], strict=False) if phase is not before]


class TestOnTheSupport:
    """Experiments in which the vehicle does not get up."""

    def test_they_are_all_that_do_not_get_up(self) -> None:
        assert set(ON_SUPPORT) == set(load("monocab").experiments) - set(EXPERIMENTS)

    def test_a_recording_at_rest_needs_no_drive(self) -> None:
        closed = ClosedLoop()
        closed.run("rest")
        assert closed.loop.reason == ""
        assert [each for each in course_of(closed) if each] == [Phase.REST, Phase.DISABLE]
        commands = {frame.data[:2] for frame in closed.raw if frame.can_id == 0x201}
        assert all(data[0] & 0x0F != 0x0F for data in commands), "a drive was enabled"

    @pytest.mark.parametrize("seed", [1, 2])
    def test_a_tilt_by_hand_ends_on_the_other_support(self, seed: int) -> None:
        closed = ClosedLoop(seed=seed)
        before = closed.loop.lean
        assert before is not None
        closed.run("tilt")
        assert closed.loop.reason == ""
        after = closed.loop.lean
        assert after is not None
        assert after.angle == pytest.approx(-before.angle, abs=math.radians(0.2))
        assert ("info", "tilt", closed.vehicle.experiments["tilt"].asks.announcement) in closed.witness.events
        assert closed.loop.state()["tilt"] is None

    def test_the_drives_move_and_the_vehicle_does_not(self) -> None:
        closed = ClosedLoop()
        closed.run("drives")
        assert closed.loop.reason == ""
        moving = [frame.values for frame in closed.witness.frames if frame.values[PHASE] == Phase.MOVE]
        assert max(abs(values[PRECESSION]) for values in moving) > math.radians(1.0)
        assert max(values[ROLL] for values in moving) - min(values[ROLL] for values in moving) < math.radians(0.2)
        assert_rests_disarmed(closed)

    def test_in_a_silence_neither_setpoints_nor_heartbeat_leave(self) -> None:
        closed = ClosedLoop()
        closed.run("silence")
        assert closed.loop.mode is Mode.DISARMED
        assert closed.loop.reason == ""
        for can_id in (0x201, 0x77F):
            sent = [frame.timestamp_ns for frame in closed.raw if frame.can_id == can_id]
            gaps = [(later - one) * 1e-9 for one, later in pairwise(sent)]
            assert max(gaps) == pytest.approx(0.5, abs=0.05)

    @pytest.mark.parametrize("name", ON_SUPPORT)
    @pytest.mark.parametrize("after", [1.0, 4.5, 6.5])
    def test_an_operator_ends_them_in_order(self, name: str, after: float) -> None:
        closed = ClosedLoop()
        closed.loop.start_experiment(name)
        closed.advance(after)
        closed.loop.end_experiment("changed my mind")
        closed.until(lambda: closed.loop.mode is not Mode.RUNNING, 30.0)
        assert closed.loop.mode is Mode.DISARMED


@pytest.mark.parametrize("rate", [100, 500])
def test_vehicle_also_balances_at_the_other_imu_rates(rate: int) -> None:
    closed = ClosedLoop(at_rate(rate))
    closed.run("doublet")
    assert closed.loop.reason == ""
    assert_rests_disarmed(closed)


def test_second_experiment_runs_after_the_first() -> None:
    closed = ClosedLoop()
    closed.run("step")
    closed.advance(1.0)
    closed.run("step")
    assert closed.loop.reason == ""
    assert len(closed.witness.recordings) == len(closed.witness.ended) == 2


def test_measured_samples_are_rebuilt_bit_for_bit_from_raw_frames() -> None:
    closed = ClosedLoop()
    closed.run("doublet")
    (_, start_ns), (_, end_ns) = closed.witness.recordings[0], closed.witness.ended[0]
    live = [frame for frame in closed.witness.frames if start_ns <= frame.timestamp_ns <= end_ns]
    raw = [frame for frame in closed.raw if start_ns <= frame.timestamp_ns]
    io, roll_filter = assembly.vehicle_io(closed.vehicle), assembly.roll_filter(closed.vehicle)
    rows = rows_from_frames(raw, io, registry.kind_of(closed.vehicle, io), roll_filter, start_ns)
    rebuilt = [row for row in rows if row.timestamp_ns <= end_ns]
    measured = MONOCAB.index_of("drive_age") + 1
    assert len(live) > 4000
    assert [(f.timestamp_ns, f.values[:measured]) for f in rebuilt] == [
        (f.timestamp_ns, f.values[:measured]) for f in live
    ]


EVERY = 7


def held_up(frames: list[CanFrame], io: VehicleIo, how: str) -> list[CanFrame]:
    """The frames as they would be on the bus if the loop had been held up at every `EVERY`-th sample.

    `late`: between the sample and its set of setpoints, which comes with the next one's. `torn`: within the set.
    `skipped`: before it read the sample, which then has no answer.
    """
    sets = [can_id for drive in io.drives for can_id in drive.config.rpdo_codecs] + [SYNC_COB_ID]
    out: list[CanFrame] = []
    late: list[CanFrame] = []
    samples = 0
    for frame in frames:
        samples += frame.can_id == io.imu.can_ids[-1]
        if frame.can_id in sets and samples % EVERY == 0 and (how != "torn" or frame.can_id != sets[0]):
            late.append(frame)
        else:
            if frame.can_id in sets and late:
                out += late if how != "skipped" else []
                late.clear()
            out.append(frame)
    return out


@pytest.mark.parametrize("how", ["late", "torn", "skipped"])
def test_setpoints_of_a_loop_that_was_held_up_return_to_their_samples(how: str) -> None:
    closed = ClosedLoop()
    closed.run("step")
    (_, start_ns), (_, end_ns) = closed.witness.recordings[0], closed.witness.ended[0]
    raw = [frame for frame in closed.raw if start_ns <= frame.timestamp_ns <= end_ns]
    io, roll_filter = assembly.vehicle_io(closed.vehicle), assembly.roll_filter(closed.vehicle)
    kind = registry.kind_of(closed.vehicle, io)
    expected = [row.values[SETPOINT] for row in rows_from_frames(raw, io, kind, roll_filter, start_ns)]
    found = [row.values[SETPOINT] for row in rows_from_frames(held_up(raw, io, how), io, kind, roll_filter, start_ns)]
    assert len({*expected}) > 1000
    if how == "skipped":
        samples = sum(frame.can_id == io.imu.can_ids[-1] for frame in raw)
        for sample in range(EVERY, samples + 1, EVERY):
            place = sample - 1 - (samples - len(expected))
            expected[place] = expected[place - 1]
    assert found == expected


@pytest.mark.parametrize("samples", [0, 1])
def test_sets_of_setpoints_without_samples_are_read(samples: int) -> None:
    """As in a log of the drives' bus alone, or one in which the IMU falls silent; in time that grows with their number.
    A CAN error frame has no id: its error class may look like that of SYNC."""
    closed = ClosedLoop()
    closed.advance(1.0)
    io = assembly.vehicle_io(closed.vehicle)
    others = [frame for frame in closed.raw if frame.can_id not in io.imu.can_ids]
    imu = [frame for frame in closed.raw if frame.can_id in io.imu.can_ids][: samples * len(io.imu.can_ids)]
    error = CanFrame(others[-1].timestamp_ns, SYNC_COB_ID, bytes(8), 0, error=True)
    kind, roll_filter = registry.kind_of(closed.vehicle, io), assembly.roll_filter(closed.vehicle)
    rows = list(rows_from_frames([*others, *imu, *100 * others, error], io, kind, roll_filter))
    assert len(rows) == samples


@pytest.mark.parametrize("held_back", [3, 50])
def test_rows_do_not_depend_on_how_many_samples_are_held_back(held_back: int, monkeypatch: pytest.MonkeyPatch) -> None:
    closed = ClosedLoop()
    closed.run("step")
    (_, start_ns), (_, end_ns) = closed.witness.recordings[0], closed.witness.ended[0]
    raw = [frame for frame in closed.raw if start_ns <= frame.timestamp_ns <= end_ns]
    io, roll_filter = assembly.vehicle_io(closed.vehicle), assembly.roll_filter(closed.vehicle)
    kind, late = registry.kind_of(closed.vehicle, io), held_up(raw, io, "late")
    expected = [row.values[SETPOINT] for row in rows_from_frames(late, io, kind, roll_filter, start_ns)]
    monkeypatch.setattr(rows_module, "HELD_BACK", held_back)
    assert [row.values[SETPOINT] for row in rows_from_frames(late, io, kind, roll_filter, start_ns)] == expected


def test_operator_request_ends_the_experiment_in_order() -> None:
    closed = ClosedLoop()
    closed.loop.start_experiment("hold")
    closed.advance(10.0)
    closed.loop.end_experiment("an operator requested the end")
    closed.until(lambda: closed.loop.mode is not Mode.RUNNING, 30.0)
    assert closed.loop.mode is Mode.DISARMED
    assert closed.loop.reason == "an operator requested the end"
    assert_rests_disarmed(closed)


@pytest.mark.parametrize("after", [0.5, 4.02, 4.6, 4.9])
def test_experiment_ends_in_order_from_every_phase_on_the_way_up(after: float) -> None:
    closed = ClosedLoop()
    closed.loop.start_experiment("hold")
    closed.advance(0.2 + after)
    closed.loop.end_experiment("changed my mind")
    closed.until(lambda: closed.loop.mode is not Mode.RUNNING, 30.0)
    assert closed.loop.mode is Mode.DISARMED
    assert_rests_disarmed(closed)


def test_immediate_stop_brakes_the_drives_and_is_latched() -> None:
    closed = ClosedLoop()
    closed.loop.start_experiment("hold")
    closed.advance(10.0)
    closed.loop.stop_now("an operator requested an immediate stop")
    assert closed.loop.mode is Mode.FAULT
    closed.advance(3.0)
    assert closed.loop.io.state is State.SWITCH_ON_DISABLED
    assert abs(closed.loop.drives.precession_rate) < 1e-3
    assert "A fault is latched: an operator" in closed.loop.interlocks()[0]
    assert closed.loop.reset_fault() == ""
    closed.loop.set_up_done()
    closed.loop.look_after_drives()
    closed.advance(1.0)
    assert closed.loop.mode is Mode.DISARMED
    assert len(closed.witness.ended) == 1


def test_drive_fault_persists_until_a_reset_which_enables_no_drive() -> None:
    closed = ClosedLoop(faults=["drive_fault:trim@12"])
    closed.loop.start_experiment("hold")
    closed.until(lambda: closed.loop.mode is not Mode.RUNNING, 40.0)
    closed.advance(3.0)
    closed.loop.set_up_done()
    closed.loop.look_after_drives()
    closed.advance(2.0)
    assert closed.loop.io.drives[2].state is State.FAULT
    assert closed.loop.reset_fault() == ""
    closed.loop.set_up_done()
    closed.loop.look_after_drives()
    closed.advance(2.0)
    assert closed.loop.io.state is State.SWITCH_ON_DISABLED
    assert closed.loop.interlocks() == []


def test_no_experiment_starts_while_the_drives_are_being_set_up() -> None:
    closed = ClosedLoop()
    closed.loop.needs_set_up = True
    assert closed.loop.mode is Mode.DISARMED
    assert closed.loop.interlocks() == ["The drives are being set up."]


def test_only_communication_faults_are_acknowledged_automatically() -> None:
    closed = ClosedLoop()
    closed.loop.set_up_done({"trim": 0x8130, "gimbal_left": 0x2310})
    assert {drive.config.name for drive in closed.loop._to_acknowledge} == {"trim"}


FAULTS = [
    ("imu_stuck@12", "imu_stuck"),
    ("imu_gap@12", "imu_silent"),
    ("drive_fault:gimbal_left@12", "drive_emergency"),
    ("drive_silent:trim@12", "drive_silent"),
    ("drive_restart:gimbal_right@12", "drive_silent"),
]


@pytest.mark.parametrize(("fault", "code"), FAULTS)
def test_fault_stops_the_run_and_gives_its_reason(fault: str, code: str) -> None:
    closed = ClosedLoop(faults=[fault])
    closed.loop.start_experiment("hold")
    closed.until(lambda: closed.loop.mode is not Mode.RUNNING, 40.0)
    assert closed.loop.mode is Mode.FAULT
    assert closed.loop.code == code
    assert len(closed.loop.reason) > 20
    for drive in closed.loop.io.drives:
        assert drive.controlword & 0x0F != 0x0F
    closed.advance(4.0)
    assert closed.loop.io.state is not State.OPERATION_ENABLED
    assert closed.witness.ended, "the recording goes on for a moment, then ends"


def test_fault_is_latched_if_no_frames_reach_the_drives() -> None:
    closed = ClosedLoop()
    closed.loop.start_experiment("hold")
    closed.advance(10.0)
    closed.late = True
    closed.advance(1.0)
    assert closed.loop.mode is Mode.FAULT


def test_only_the_last_of_several_late_cycles_is_answered() -> None:
    closed = ClosedLoop()
    closed.loop.start_experiment("hold")
    closed.advance(10.0)
    sent = len(closed.raw)
    held_up = [frame for frame in closed.raw[-400:] if frame.can_id in closed.loop.io.imu.can_ids][-9:]
    moved = [type(frame)(frame.timestamp_ns + 3 * 4_000_000, frame.can_id, frame.data) for frame in held_up]
    closed.loop.on_frames(moved)
    setpoints = [frame for frame in closed.raw[sent:] if frame.can_id == 0x201]
    assert len(setpoints) == 1


class TestAnException:
    """Whatever is raised on the path of a sample stops the vehicle like any other fault."""

    @pytest.fixture
    def upright(self) -> ClosedLoop:
        closed = ClosedLoop()
        closed.loop.start_experiment("hold")
        closed.advance(10.0)
        return closed

    @staticmethod
    def raising(*arguments: object) -> object:
        raise ZeroDivisionError("division by zero")

    def test_in_one_cycle_is_a_latched_fault_with_a_reason_and_one_log_entry(
        self, upright: ClosedLoop, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
    ) -> None:
        loop = upright.loop
        with monkeypatch.context() as broken:
            broken.setattr(loop.kind, "measure", self.raising)
            upright.advance(1.5)
        assert (loop.mode, loop.code) == (Mode.FAULT, "internal_error")
        assert "ZeroDivisionError: division by zero (test_control_loop.py, line" in loop.reason
        assert [record.exc_info is not None for record in caplog.records] == [True]
        upright.advance(1.0)
        assert loop.io.state is State.SWITCH_ON_DISABLED
        assert loop.reset_fault() == ""

    @pytest.mark.parametrize("place", ["_judge", "_decide", "_transmit"])
    def test_wherever_it_is_raised_the_drives_are_off(
        self, upright: ClosedLoop, place: str, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr(upright.loop, place, self.raising)
        upright.advance(3.0)
        assert upright.loop.mode is Mode.FAULT
        states = {drive.state.name for drive in upright.plant_side.drives.values()}
        assert not states & {"OPERATION_ENABLED", "QUICK_STOP_ACTIVE"}, states

    def test_in_a_disarmed_vehicle_is_latched_too(self, monkeypatch: pytest.MonkeyPatch) -> None:
        closed = ClosedLoop()
        with monkeypatch.context() as broken:
            broken.setattr(closed.loop, "_judge", self.raising)
            closed.advance(0.1)
        assert closed.loop.code == "internal_error"
        assert [code for _, code, _ in closed.witness.events] == ["internal_error"]


def test_loss_of_the_observer_ends_the_experiment_in_order() -> None:
    closed = ClosedLoop()
    closed.loop.start_experiment("hold")
    closed.advance(10.0)
    closed.loop.observer_gone()
    closed.until(lambda: closed.loop.mode is not Mode.RUNNING, 30.0)
    assert closed.loop.mode is Mode.DISARMED
    assert "observer" in closed.loop.reason
    assert_rests_disarmed(closed)


def test_bus_down_is_a_fault_while_running_and_an_interlock_otherwise() -> None:
    closed = ClosedLoop()
    closed.lose_bus()
    assert closed.loop.mode is Mode.STARTING
    assert "interface went down" in closed.loop.interlocks()[0]
    closed.loop.set_up_done()
    closed.loop.start_experiment("hold")
    closed.advance(10.0)
    closed.lose_bus()
    assert closed.loop.mode is Mode.FAULT
    assert closed.loop.code == "bus_down"


def test_vehicle_that_is_not_on_its_support_is_refused() -> None:
    closed = ClosedLoop()
    closed.vehicle = closed.loop.vehicle = closed.vehicle.model_copy(
        update={"limits": closed.vehicle.limits.model_copy(update={"support_deg": 2.0})}
    )
    assert "does not rest on a support" in closed.loop.interlocks()[0]
    assert "imu.axes" in closed.loop.interlocks()[0]


def test_static_torque_within_the_limits_is_balanced() -> None:
    closed = ClosedLoop(hide=["static_torque"])
    closed.run("hold")
    assert closed.loop.reason == ""
    assert_rests_disarmed(closed)
