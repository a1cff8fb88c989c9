"""The CiA 402 state machine, the PDO codecs and a drive at run time, compared with independently written models."""

from __future__ import annotations

import math
import struct
from collections import deque
from dataclasses import dataclass, replace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from upright.drivers.cia301 import emergency, nmt
from upright.drivers.cia301.nmt import NmtCommand, NmtState
from upright.drivers.cia402 import states
from upright.drivers.cia402.config import DriveConfig, DriveConfigError, find_eds
from upright.drivers.cia402.drive import Drive
from upright.drivers.cia402.states import FaultReset, FaultResetOutcome, State, classify, controlword_towards
from upright.telemetry.samples import CanFrame

GIMBAL = DriveConfig(
    name="gimbal",
    role="gimbal",
    node=1,
    direction=-1,
    axis_per_turn=2 * math.pi / 100,
    mode=2,
    increments_per_turn=65536,
    velocity_unit_rpm=1 / 8192,
    rated_torque=10.0,
    rpdo=(("controlword", "target_velocity", "target_velocity_fine"),),
    tpdo=(("statusword", "velocity_actual", "torque_actual"), ("position_actual",)),
)
COARSE = replace(GIMBAL, rpdo=(("controlword", "target_velocity"),), direction=1)
CYCLIC = replace(GIMBAL, mode=9, rpdo=(("controlword", "target_velocity"),))

WORDS = {
    State.NOT_READY_TO_SWITCH_ON: 0x0200,
    State.SWITCH_ON_DISABLED: 0x0240,
    State.READY_TO_SWITCH_ON: 0x0231,
    State.SWITCHED_ON: 0x0233,
    State.OPERATION_ENABLED: 0x0237,
    State.QUICK_STOP_ACTIVE: 0x0217,
    State.FAULT_REACTION_ACTIVE: 0x021F,
    State.FAULT: 0x0218,
}
"""A statusword of each state, with voltage enabled and remote set as drives do."""

TARGETS = [
    State.SWITCH_ON_DISABLED,
    State.READY_TO_SWITCH_ON,
    State.SWITCHED_ON,
    State.OPERATION_ENABLED,
    State.QUICK_STOP_ACTIVE,
]


def drive_in(state: State, config: DriveConfig = GIMBAL) -> Drive:
    drive = Drive(config)
    report(drive, state)
    return drive


def report(drive: Drive, state: State, timestamp_ns: int = 1) -> None:
    """Feed the drive a TPDO1 with a statusword of `state`."""
    drive.handle(CanFrame(timestamp_ns, 0x181, struct.pack("<Hih", WORDS[state], 0, 0)))


def controlword(drive: Drive, target: State, velocity: float = 0.0) -> int:
    ((_, data),) = drive.command(target, velocity)
    return int.from_bytes(data[:2], "little")


# State machine


def state_by_the_standard(word: int) -> State:
    """The table of CiA 402, evaluated bit by bit: 6 switch on disabled, 5 quick stop, 3 fault, 2 to 0."""
    switch_on_disabled, quick_stop, fault = word >> 6 & 1, word >> 5 & 1, word >> 3 & 1
    low = word & 0b111
    if fault:
        return {
            (0, 0b000): State.FAULT,
            (0, 0b111): State.FAULT_REACTION_ACTIVE,
        }.get((switch_on_disabled, low), State.UNKNOWN)
    if switch_on_disabled:
        return State.SWITCH_ON_DISABLED if low == 0 else State.UNKNOWN
    if low == 0:
        return State.NOT_READY_TO_SWITCH_ON
    return {
        (1, 0b001): State.READY_TO_SWITCH_ON,
        (1, 0b011): State.SWITCHED_ON,
        (1, 0b111): State.OPERATION_ENABLED,
        (0, 0b111): State.QUICK_STOP_ACTIVE,
    }.get((quick_stop, low), State.UNKNOWN)


def test_every_statusword_is_classified_as_in_the_standard() -> None:
    wrong = [word for word in range(0x10000) if classify(word) is not state_by_the_standard(word)]
    assert wrong == []
    assert {classify(word) for word in range(0x10000)} == set(State)


@pytest.mark.parametrize("state", list(State))
def test_enable_operation_is_only_sent_towards_operation_enabled(state: State) -> None:
    for target in TARGETS:
        word = controlword_towards(state, target)
        assert not word & 0x80, "a fault reset is never part of the way"
        if word & 0x0F == 0x0F:
            assert target is State.OPERATION_ENABLED
            assert state in (State.SWITCHED_ON, State.OPERATION_ENABLED)


@pytest.mark.parametrize(
    "target", [State.NOT_READY_TO_SWITCH_ON, State.FAULT_REACTION_ACTIVE, State.FAULT, State.UNKNOWN]
)
def test_target_state_that_cannot_be_commanded_is_refused(target: State) -> None:
    with pytest.raises(ValueError, match=target.value):
        controlword_towards(State.SWITCHED_ON, target)


def test_flags_of_a_statusword_are_named() -> None:
    assert states.flags(0x0A97) == ("voltage enabled", "warning", "remote", "internal limit active")


class DriveOfTheStandard:
    """The power drive system of the figure in CiA 402, with states as strings, by transition number. For tests only.

    `quick_stop_option` is 605Ah: 2 leaves quick stop active by itself after two cycles, 6 stays there.
    """

    def __init__(self, quick_stop_option: int) -> None:
        self.at = "switch on disabled"
        self.quick_stop_option = quick_stop_option
        self.stopping = 0
        self.last_word = 0

    def statusword(self) -> int:
        return {
            "switch on disabled": 0x0250,
            "ready": 0x0231,
            "switched on": 0x0233,
            "enabled": 0x0237,
            "quick stop": 0x0217,
            "fault reaction": 0x021F,
            "fault": 0x0218,
        }[self.at]

    def take(self, word: int) -> None:
        edge = word & 0x80 and not self.last_word & 0x80
        self.last_word = word
        enable_voltage, quick_stop_off, switch_on, enable = word & 2, word & 4, word & 1, word & 8
        if self.at == "fault reaction":
            self.at = "fault"  # 14
        elif self.at == "fault":
            if edge:
                self.at = "switch on disabled"  # 15
        elif self.at == "quick stop":
            self.stopping += 1
            if not enable_voltage or (self.quick_stop_option == 2 and self.stopping > 2):
                self.at = "switch on disabled"  # 12
            elif self.quick_stop_option == 6 and word & 0x0F == 0x0F:
                self.at = "enabled"  # 16
        elif not enable_voltage:
            self.at = "switch on disabled"  # 7, 9, 10
        elif not quick_stop_off:
            if self.at == "enabled":
                self.at, self.stopping = "quick stop", 0  # 11
            else:
                self.at = "switch on disabled"  # 7, 10
        elif not switch_on:
            self.at = "ready"  # 2, 6, 8
        elif self.at in ("ready", "switched on", "enabled"):
            if self.at == "ready":
                self.at = "switched on"  # 3
            else:
                self.at = "enabled" if enable else "switched on"  # 4, 5


@dataclass(frozen=True)
class Cycle:
    """The request of the master in one cycle, and the mishap of the drive in it."""

    target: State
    reset: bool
    mishap: str


cycles = st.lists(
    st.builds(
        Cycle,
        # Mostly enabled, as in a run: otherwise a random sequence would hardly ever reach Operation enabled.
        target=st.sampled_from([State.OPERATION_ENABLED] * 6 + TARGETS),
        reset=st.booleans(),
        mishap=st.sampled_from(["none"] * 8 + ["fault", "torque off", "frame lost"]),
    ),
    max_size=60,
)


@settings(max_examples=300, deadline=None)
@given(cycles=cycles, quick_stop_option=st.sampled_from([2, 6]), latency=st.integers(0, 3))
def test_drive_is_never_enabled_again_before_the_target_was_lowered(
    cycles: list[Cycle], quick_stop_option: int, latency: int
) -> None:
    """After a mishap, the drive is enabled again only after the target was lowered and raised."""
    drive, plant = Drive(GIMBAL), DriveOfTheStandard(quick_stop_option)
    in_transit = deque([plant.statusword()] * latency)
    lowered = True  # the target has been below Operation enabled since the last mishap
    for number, cycle in enumerate(cycles, start=1):
        if cycle.reset:
            drive.request_fault_reset(patience=5)
        before = plant.at
        word = controlword(drive, cycle.target)
        plant.take(word)
        if cycle.target is not State.OPERATION_ENABLED:
            lowered = True
            assert word & 0x0F != 0x0F
        if plant.at == "enabled" and before != "enabled":
            assert lowered
        if cycle.mishap == "fault":
            if plant.at != "fault":
                plant.at = "fault reaction"
            lowered = False
        elif cycle.mishap == "torque off" and plant.at in ("enabled", "quick stop", "switched on", "ready"):
            if plant.at == "enabled":
                lowered = False
            plant.at = "switch on disabled"
        in_transit.append(plant.statusword())
        arrived = in_transit.popleft()
        if cycle.mishap != "frame lost":
            drive.handle(CanFrame(number, 0x181, struct.pack("<Hih", arrived, 0, 0)))


@settings(max_examples=100, deadline=None)
@given(cycles=cycles, quick_stop_option=st.sampled_from([2, 6]), latency=st.integers(0, 3))
def test_drive_can_always_be_enabled_by_lowering_resetting_and_raising(
    cycles: list[Cycle], quick_stop_option: int, latency: int
) -> None:
    """After any sequence: target down, fault reset, target up leads to Operation enabled, and quick stop leaves it."""
    drive, plant = Drive(GIMBAL), DriveOfTheStandard(quick_stop_option)
    in_transit = deque([plant.statusword()] * latency)

    def run(target: State, count: int) -> None:
        for _ in range(count):
            plant.take(controlword(drive, target))
            in_transit.append(plant.statusword())
            drive.handle(CanFrame(1, 0x181, struct.pack("<Hih", in_transit.popleft(), 0, 0)))

    for cycle in cycles:
        if cycle.mishap == "fault":
            plant.at = "fault"
        run(cycle.target, 1)
    # Each of at most four steps takes the latency and one cycle; a pending reset or an automatic transition doubles it.
    steps = 8 * (latency + 1)
    run(State.SWITCH_ON_DISABLED, steps)
    if plant.at == "fault":
        assert drive.request_fault_reset(patience=steps)
    run(State.SWITCH_ON_DISABLED, steps)
    assert plant.at == "switch on disabled"
    run(State.OPERATION_ENABLED, steps)
    assert plant.at == "enabled"
    run(State.QUICK_STOP_ACTIVE, steps)
    assert plant.at == ("switch on disabled" if quick_stop_option == 2 else "quick stop")


# Fault reset and latches of a drive


def test_fault_reset_is_a_rising_edge_that_ends_with_the_fault() -> None:
    reset = FaultReset(patience=10)
    assert [reset.controlword(State.FAULT) for _ in range(3)] == [0x0000, 0x0080, 0x0080]
    assert reset.controlword(State.SWITCH_ON_DISABLED) == 0x0000
    assert reset.outcome is FaultResetOutcome.DONE


def test_fault_reset_gives_up_with_bit_7_low_again() -> None:
    drive = drive_in(State.FAULT)
    assert drive.request_fault_reset(patience=4)
    words = [controlword(drive, State.SWITCH_ON_DISABLED) for _ in range(7)]
    assert words == [0, 0x80, 0x80, 0x80, 0x80, 0, 0]
    assert drive.fault_reset is FaultResetOutcome.NOT_RESET
    assert drive.tripped


def test_fault_reset_is_refused_without_a_fault() -> None:
    for state in WORDS:
        if state is not State.FAULT:
            drive = drive_in(state)
            assert not drive.request_fault_reset()
            assert not controlword(drive, State.SWITCH_ON_DISABLED) & 0x80
    assert not Drive(GIMBAL).request_fault_reset()


def test_after_a_fault_reset_the_target_must_be_lowered_before_enabling() -> None:
    drive = drive_in(State.OPERATION_ENABLED)
    assert controlword(drive, State.OPERATION_ENABLED) == 0x7F
    report(drive, State.FAULT)
    assert drive.tripped
    assert "Fault" in drive.trip_reason
    assert drive.request_fault_reset()
    assert [controlword(drive, State.OPERATION_ENABLED) for _ in range(2)] == [0, 0x80]
    report(drive, State.SWITCH_ON_DISABLED)
    held = [controlword(drive, State.OPERATION_ENABLED) for _ in range(50)]
    assert set(held) == {states.QUICK_STOP}, "in Switch on disabled this word does nothing"
    assert drive.fault_reset is FaultResetOutcome.DONE
    controlword(drive, State.SWITCH_ON_DISABLED)
    assert not drive.tripped
    assert controlword(drive, State.OPERATION_ENABLED) == states.SHUTDOWN


def test_drive_that_re_enables_itself_is_quick_stopped() -> None:
    """Some inverters clear a fault and continue by themselves; that must end in a quick stop."""
    drive = drive_in(State.OPERATION_ENABLED)
    controlword(drive, State.OPERATION_ENABLED)
    report(drive, State.FAULT)
    report(drive, State.OPERATION_ENABLED)
    ((_, data),) = drive.command(State.OPERATION_ENABLED, 0.5)
    assert struct.unpack("<Hhh", data) == (states.QUICK_STOP, 0, 0)


def test_a_drive_that_drops_out_by_itself_is_held_in_quick_stop() -> None:
    drive = drive_in(State.OPERATION_ENABLED)
    controlword(drive, State.OPERATION_ENABLED)
    report(drive, State.SWITCH_ON_DISABLED)  # for example by safe torque off
    assert controlword(drive, State.OPERATION_ENABLED) == states.QUICK_STOP
    assert drive.tripped
    assert "Switch on disabled" in drive.condition


def test_a_drive_that_drops_out_before_it_was_seen_enabled_is_not_enabled_again() -> None:
    drive = drive_in(State.SWITCHED_ON)
    assert controlword(drive, State.OPERATION_ENABLED) == 0x7F
    report(drive, State.SWITCHED_ON)
    assert not drive.tripped, "the answer of the cycle before: on its way"
    controlword(drive, State.OPERATION_ENABLED)
    report(drive, State.SWITCH_ON_DISABLED)
    assert controlword(drive, State.OPERATION_ENABLED) == states.QUICK_STOP


def test_drop_to_switched_on_is_answered_with_quick_stop() -> None:
    drive = drive_in(State.OPERATION_ENABLED)
    controlword(drive, State.OPERATION_ENABLED)
    report(drive, State.SWITCHED_ON)
    assert controlword(drive, State.OPERATION_ENABLED) == states.QUICK_STOP


def test_fault_during_enabling_that_clears_itself_is_held_in_quick_stop() -> None:
    drive = drive_in(State.READY_TO_SWITCH_ON)
    controlword(drive, State.OPERATION_ENABLED)
    report(drive, State.FAULT)
    assert controlword(drive, State.OPERATION_ENABLED) == states.QUICK_STOP, "no effect in Fault, and bit 7 is low"
    report(drive, State.SWITCH_ON_DISABLED)
    assert controlword(drive, State.OPERATION_ENABLED) == states.QUICK_STOP
    assert "while it was to be enabled" in drive.trip_reason


def test_leaving_operation_enabled_on_command_is_not_a_trip() -> None:
    drive = drive_in(State.OPERATION_ENABLED)
    controlword(drive, State.OPERATION_ENABLED)
    controlword(drive, State.QUICK_STOP_ACTIVE)
    for state in (State.QUICK_STOP_ACTIVE, State.SWITCH_ON_DISABLED):
        report(drive, state)
        assert controlword(drive, State.QUICK_STOP_ACTIVE) == states.QUICK_STOP
        assert not drive.tripped


@pytest.mark.parametrize("target", TARGETS)
def test_controlword_is_disable_voltage_before_the_first_statusword(target: State) -> None:
    assert controlword(Drive(GIMBAL), target, velocity=1.0) == 0


# Setpoints


@pytest.mark.parametrize("config", [GIMBAL, COARSE, CYCLIC], ids=["fine", "coarse", "cyclic"])
@given(velocity=st.floats(-30.0, 30.0))
def test_setpoint_is_sent_within_half_a_step_and_read_back_bit_for_bit(config: DriveConfig, velocity: float) -> None:
    drive, reader = drive_in(State.OPERATION_ENABLED, config), Drive(config)
    ((cob_id, data),) = drive.command(State.OPERATION_ENABLED, velocity)
    assert abs(drive.setpoint - velocity) <= abs(config.setpoint_unit) * 0.5000001
    reader.handle(CanFrame(1, cob_id, data))
    assert struct.pack("<d", reader.setpoint) == struct.pack("<d", drive.setpoint)
    assert reader.controlword == drive.controlword
    # Decoded from the units of the objects alone: rpm, 1/8192 rpm.
    if config.mode == 9:
        word, units = struct.unpack("<Hi", data)
        rpm = units / 8192
        assert word == 0x0F
    else:
        word, rpm, fine = struct.unpack("<Hhh", data) if len(data) == 6 else (*struct.unpack("<Hh", data), 0)
        rpm += fine / 8192
        assert word == 0x7F
        assert abs(fine) <= 4096, "the coarse part alone is right within half a revolution a minute"
    assert drive.setpoint == pytest.approx(config.direction * rpm / 60 * config.axis_per_turn, abs=1e-12)


@pytest.mark.parametrize(
    ("config", "velocity", "expected"),
    [
        (COARSE, 1e6, (32767,)),
        (COARSE, -1e6, (-32768,)),
        (GIMBAL, -1e6, (32767, 4095)),
        (GIMBAL, 1e6, (-32768, -4096)),
        (CYCLIC, math.inf, (-(2**31),)),
        (COARSE, math.nan, (0,)),
    ],
)
def test_setpoint_out_of_range_is_limited_and_counted(
    config: DriveConfig, velocity: float, expected: tuple[int, ...]
) -> None:
    drive = drive_in(State.OPERATION_ENABLED, config)
    ((_, data),) = drive.command(State.OPERATION_ENABLED, velocity)
    assert struct.unpack({6: "<hh", 4: "<h"}[len(data)] if config.mode == 2 else "<i", data[2:]) == expected
    assert drive.clipped == 1
    assert math.isfinite(drive.setpoint)


@given(velocity=st.floats(-30.0, 30.0))
def test_setpoint_is_rounded_to_the_resolution_of_the_drive(velocity: float) -> None:
    config = replace(GIMBAL, setpoint_resolution=0.047)
    drive = drive_in(State.OPERATION_ENABLED, config)
    drive.command(State.OPERATION_ENABLED, velocity)
    assert abs(drive.setpoint - velocity) <= 0.5000001 * 0.047
    assert drive.setpoint == config.resolved(velocity) == -config.resolved(-velocity)


def test_nan_velocity_gives_a_zero_setpoint_and_is_counted() -> None:
    drive = drive_in(State.OPERATION_ENABLED, replace(GIMBAL, setpoint_resolution=0.047))
    drive.command(State.OPERATION_ENABLED, math.nan)
    assert drive.setpoint == 0.0
    assert drive.clipped == 1


@pytest.mark.parametrize("state", [state for state in WORDS if state is not State.OPERATION_ENABLED])
def test_velocity_is_only_sent_to_an_enabled_drive(state: State) -> None:
    drive = drive_in(state)
    ((_, data),) = drive.command(State.OPERATION_ENABLED, 0.7)
    assert data[2:] == bytes(4)
    assert math.copysign(1.0, drive.setpoint) == 1.0, "zero, and not minus zero"


def test_controlword_and_setpoint_may_be_in_different_pdos() -> None:
    config = replace(GIMBAL, rpdo=(("controlword",), ("target_velocity_fine", "target_velocity")))
    drive, reader = drive_in(State.OPERATION_ENABLED, config), Drive(config)
    frames = drive.command(State.OPERATION_ENABLED, -0.123)
    assert [cob_id for cob_id, _ in frames] == [0x201, 0x301]
    for cob_id, data in frames:
        reader.handle(CanFrame(1, cob_id, data))
    assert reader.setpoint == drive.setpoint != 0.0


# Measured values


def test_measured_values_are_axis_values_in_si_units() -> None:
    drive = Drive(GIMBAL)
    assert math.isnan(drive.position)
    assert drive.timestamp_ns == 0
    # 1500 rpm, 25 % of 10 N m, and a quarter turn of the gimbal: 25 motor turns; mirrored drive.
    drive.handle(CanFrame(70, 0x181, struct.pack("<Hih", 0x0237, 1500 * 8192, 250)))
    assert drive.timestamp_ns == 0, "no position yet"
    drive.handle(CanFrame(90, 0x281, struct.pack("<i", 25 * 65536)))
    assert drive.velocity == pytest.approx(-1500 / 60 * 2 * math.pi / 100)
    assert drive.torque == pytest.approx(-2.5)
    assert drive.position == pytest.approx(-math.pi / 2)
    assert (drive.timestamp_ns, drive.position_timestamp_ns, drive.statusword_timestamp_ns) == (70, 90, 70)


def test_velocity_in_rpm_and_mode_display_can_be_mapped() -> None:
    config = replace(COARSE, tpdo=(("statusword", "velocity_actual_rpm", "mode_display"), ("position_actual",)))
    drive = Drive(config)
    drive.handle(CanFrame(1, 0x181, struct.pack("<Hhb", 0x0237, -600, 2)))
    assert drive.velocity == pytest.approx(-10 * 2 * math.pi / 100)
    assert drive.mode_display == 2


@pytest.mark.parametrize("data", [b"", b"\x37", bytes(7), struct.pack("<Hih", 0x0237, 0, 0)[:-1]])
def test_a_frame_of_the_wrong_length_is_counted_and_not_used(data: bytes) -> None:
    drive = Drive(GIMBAL)
    for can_id in (0x181, 0x201, 0x081, 0x701):
        before = drive.wrong_length
        if can_id == 0x701 and len(data) == 1:
            continue
        drive.handle(CanFrame(5, can_id, data))
        assert drive.wrong_length == before + 1
        assert f"{can_id:03X}h has {len(data)} bytes" in drive.last_wrong_length
        assert "node 1" in drive.last_wrong_length
    assert drive.state is State.UNKNOWN
    assert drive.emergency is None


@given(can_id=st.sampled_from([0x181, 0x281, 0x201, 0x081, 0x701]), data=st.binary(max_size=8))
def test_no_frame_makes_a_drive_raise(can_id: int, data: bytes) -> None:
    drive = Drive(GIMBAL)
    drive.handle(CanFrame(1, can_id, data))
    assert len(drive.command(State.OPERATION_ENABLED, 0.1)) == 1
    assert drive.condition


def test_frames_of_other_nodes_are_ignored() -> None:
    drive = Drive(GIMBAL)
    for can_id in (0x182, 0x282, 0x082, 0x702, 0x000):
        assert can_id not in drive.can_ids
        drive.handle(CanFrame(1, can_id, bytes(8)))
    assert drive.wrong_length == 0
    assert drive.statusword is None


def test_reset_clears_measurements_and_keeps_the_state_machine() -> None:
    drive = drive_in(State.OPERATION_ENABLED)
    drive.handle(CanFrame(9, 0x281, bytes(4)))
    drive.command(State.OPERATION_ENABLED, 0.3)
    drive.reset()
    assert math.isnan(drive.position)
    assert math.isnan(drive.velocity)
    assert drive.timestamp_ns == 0
    assert drive.setpoint == 0.0
    assert controlword(drive, State.OPERATION_ENABLED) == 0x7F, "a running drive runs on"
    assert not drive.tripped


# Emergencies, heartbeat, restart


@pytest.mark.parametrize(
    ("code", "words"),
    [
        (0x8130, "heartbeat or life guard lost"),
        (0x8120, "CAN in error passive"),
        (0x8140, "recovered from bus-off"),
        (0x8250, "RPDO timeout"),
        (0x2310, "continuous over-current"),
        (0x3210, "DC link over-voltage"),
        (0x3220, "DC link under-voltage"),
        (0x4210, "device over-temperature"),
        (0x7305, "incremental encoder 1"),
        (0x7307, "sensor"),  # not in the table: named by its class
        (0x2311, "continuous over-current"),
        (0x8F42, "monitoring"),
        (0xFF7F, "vendor-specific"),
        (0xA123, "unknown error"),
        (0x0001, "unknown error"),
    ],
)
def test_error_codes_are_named_by_their_closest_class(code: int, words: str) -> None:
    assert emergency.describe(code) == f"{code:04X}h {words}"


def test_every_error_code_has_a_text() -> None:
    assert all(emergency.describe(code).startswith(f"{code:04X}h ") for code in range(0x10000))


def test_emergency_stays_active_until_it_is_cleared() -> None:
    drive = Drive(GIMBAL)
    drive.handle(CanFrame(3, 0x081, struct.pack("<HB5s", 0x7305, 0b0010_0001, b"\x01\x02\x03\x04\x05")))
    assert drive.emergency is not None
    assert drive.emergency.text == (
        "7305h incremental encoder 1 (error register: generic, device profile; vendor bytes 0102030405)"
    )
    assert drive.emergency.text in drive.condition
    drive.handle(CanFrame(4, 0x081, bytes(8)))
    assert drive.emergency is None
    assert drive.last_emergency is not None
    assert drive.last_emergency.timestamp_ns == 3
    assert drive.emergency_count == 1


def test_completed_fault_reset_clears_an_emergency_that_the_drive_did_not_clear() -> None:
    drive = drive_in(State.FAULT)
    drive.handle(CanFrame(3, 0x081, struct.pack("<HB5s", 0x2310, 2, bytes(5))))
    assert drive.request_fault_reset()
    for _ in range(3):
        controlword(drive, State.SWITCH_ON_DISABLED)
        assert drive.emergency is not None, "the fault is still there"
    report(drive, State.SWITCH_ON_DISABLED)
    controlword(drive, State.SWITCH_ON_DISABLED)
    assert drive.emergency is None


def test_heartbeat_reports_the_nmt_state_and_an_unexpected_boot_up() -> None:
    drive = Drive(GIMBAL)
    for number, (byte, state) in enumerate([(b"\x00", NmtState.BOOT_UP), (b"\x85", NmtState.OPERATIONAL)], start=1):
        drive.handle(CanFrame(number, 0x701, byte))
        assert drive.nmt_state is state
        assert not drive.restarted, "nothing was running yet"
    assert drive.heartbeat_timestamp_ns == 2
    report(drive, State.OPERATION_ENABLED)
    controlword(drive, State.OPERATION_ENABLED)
    drive.handle(CanFrame(3, 0x701, b"\x00"))
    assert drive.restarted
    assert controlword(drive, State.OPERATION_ENABLED) == 0
    report(drive, State.SWITCH_ON_DISABLED)
    for target in (State.OPERATION_ENABLED, State.SWITCH_ON_DISABLED, State.OPERATION_ENABLED):
        word = controlword(drive, target)
    assert word == states.QUICK_STOP
    assert "must be set up again" in drive.condition
    drive.configured()
    assert controlword(drive, State.OPERATION_ENABLED) == states.SHUTDOWN
    drive = Drive(GIMBAL)
    drive.configured()
    drive.handle(CanFrame(1, 0x701, b"\x00"))
    assert drive.restarted, "though it had not sent anything yet"


def test_nmt_command_and_heartbeat_frames_are_encoded() -> None:
    assert nmt.command_frame(NmtCommand.START, 3) == (0x000, b"\x01\x03")
    assert nmt.heartbeat_frame(127) == (0x77F, b"\x05")


# Configuration


@pytest.mark.parametrize(
    ("change", "key", "words"),
    [
        ({"node": 0}, "node", "node id"),
        ({"direction": 0}, "direction", "sign"),
        ({"mode": 3}, "mode", "Use 2, 9, 10 or -1"),
        ({"rated_torque": math.nan}, "rated_torque", "positive"),
        ({"axis_per_turn": 0.0}, "axis_per_turn", "positive"),
        ({"setpoint_resolution": -0.1}, "setpoint_resolution", "not a resolution"),
        ({"rpdo": (("controlword",),)}, "rpdo", "'target_velocity' is not mapped"),
        ({"rpdo": (("controlword", "target_velocty"),)}, "rpdo", "'target_velocty' cannot be mapped"),
        ({"rpdo": (("controlword", "target_velocity", "statusword"),)}, "rpdo", "'statusword' cannot be mapped"),
        ({"mode": 9}, "rpdo", "'target_velocity_fine' cannot be mapped here in mode 9"),
        ({"tpdo": (("statusword", "position_actual", "velocity_actual"),)}, "tpdo", "has 10 bytes"),
        ({"tpdo": (("statusword", "velocity_actual"),)}, "tpdo", "'position_actual' is not mapped"),
        ({"tpdo": (("statusword", "position_actual"),)}, "tpdo", "one velocity"),
        ({"tpdo": (("statusword", "statusword"), ("position_actual",))}, "tpdo", "mapped twice"),
        ({"tpdo": ((), ("statusword", "position_actual"), ("velocity_actual",))}, "tpdo", "has 0 bytes"),
        ({"tpdo": (("statusword",),) * 5}, "tpdo", "5 PDOs"),
    ],
)
def test_invalid_configuration_error_names_drive_and_key(change: dict[str, object], key: str, words: str) -> None:
    with pytest.raises(DriveConfigError, match=words) as caught:
        replace(GIMBAL, **change)  # type: ignore[arg-type]
    assert caught.value.key == key
    assert caught.value.drive == "gimbal"
    assert caught.value.remedy


def test_missing_eds_error_lists_the_shipped_files() -> None:
    assert find_eds("upright_servo.eds", drive="gimbal").is_file()
    with pytest.raises(DriveConfigError, match=r"'keb\.eds'.*upright_servo\.eds"):
        find_eds("keb.eds", drive="gimbal")
