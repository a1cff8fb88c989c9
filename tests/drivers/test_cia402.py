"""The CiA 402 state machine, and a drive's latches, compared with independently written models."""

from __future__ import annotations

import struct
from collections import deque
from dataclasses import dataclass

import pytest
from cia402_drives import GIMBAL, TARGETS, WORDS, controlword, drive_in, report
from hypothesis import given, settings
from hypothesis import strategies as st

from upright.drivers.cia402 import states
from upright.drivers.cia402.drive import Drive
from upright.drivers.cia402.states import FaultReset, FaultResetOutcome, State, classify, controlword_towards
from upright.telemetry.samples import CanFrame

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
