"""The simulated servo inverter as a CiA 402 slave: states, PDOs, deadlines and the loss of the master."""

from __future__ import annotations

import math
import struct
from dataclasses import replace

import pytest
from simulated_bus import (
    DISABLE_VOLTAGE,
    ENABLE,
    FAULT_RESET,
    GIMBAL_PER_TURN,
    QUICK_STOP,
    SHUTDOWN,
    SWITCH_ON,
    Harness,
    drive_nodes,
)

from upright.simulation.bus.object_dictionary import SimulationError
from upright.simulation.bus.power_state import Command, PowerState, command_of
from upright.simulation.config import SimulationConfig
from upright.simulation.faults import UnknownFaultError, parse_faults
from upright.simulation.monocab.truth import PlantTruth
from upright.simulation.physics.servo_axis import AxisMode

RPM = 200.0
RATE = GIMBAL_PER_TURN * RPM / 60.0


@pytest.fixture
def harness() -> Harness:
    harness = Harness()
    harness.set_up()
    return harness


@pytest.fixture
def moving(harness: Harness) -> Harness:
    harness.enable()
    harness.cycles(0.3, ENABLE, RPM)
    assert harness.left.servo.axis.rate == pytest.approx(RATE, rel=0.01)
    return harness


def statuswords(harness: Harness) -> list[int]:
    """The sequence of states that the left gimbal has reported in its statusword."""
    words = [struct.unpack_from("<H", data)[0] & 0x6F for data in harness.frames(0x181)]
    return [word for i, word in enumerate(words) if i == 0 or word != words[i - 1]]


def test_drive_boots_into_preoperational_and_sends_a_boot_up_message() -> None:
    harness = Harness()
    assert [harness.frames(0x700 + node) for node in (1, 2, 3)] == [[b"\x00"]] * 3
    assert harness.left.nmt_state == "PRE-OPERATIONAL"
    assert harness.left.state is PowerState.NOT_READY_TO_SWITCH_ON
    harness.cycles(0.1, ENABLE, RPM)
    assert harness.frames(0x181) == []
    assert harness.left.state is PowerState.SWITCH_ON_DISABLED


def test_enabling_passes_through_every_state(harness: Harness) -> None:
    harness.enable()
    assert statuswords(harness) == [0x00, 0x40, 0x21, 0x23, 0x27]
    assert harness.statusword() & 0x210 == 0x210
    assert harness.left.servo.axis.mode is AxisMode.DRIVEN


def test_transitions_take_the_time_of_a_power_stage(harness: Harness) -> None:
    harness.cycles(0.1, SWITCH_ON)
    assert harness.left.state is PowerState.SWITCH_ON_DISABLED
    harness.cycles(0.02, SHUTDOWN)
    harness.cycles(0.02, SWITCH_ON)
    assert harness.left.state is PowerState.SWITCHED_ON
    harness.cycles(0.02, ENABLE)
    assert harness.left.state is PowerState.SWITCHED_ON
    harness.cycles(0.02, ENABLE)
    assert harness.left.state is PowerState.OPERATION_ENABLED


def test_velocity_mode_turns_both_gimbals_the_same_way(moving: Harness) -> None:
    """Directions +1 and -1 with mirrored motor speeds; actual values are in the drive's own units."""
    gimbals = moving.vehicle.plant.gimbals
    assert gimbals[1].rate == pytest.approx(gimbals[0].rate, rel=1e-3)
    for node, sign in ((1, 1), (2, -1)):
        _, velocity, _ = struct.unpack("<Hih", moving.frames(0x180 + node)[-1])
        assert velocity / 8192 == pytest.approx(sign * RPM, rel=0.01)
        (position,) = struct.unpack("<i", moving.frames(0x280 + node)[-1])
        angle = sign * position / 65536 * GIMBAL_PER_TURN
        assert angle == pytest.approx(gimbals[node - 1].angle, abs=RATE * 0.004)
    assert moving.statusword() & 0x400


def test_fine_part_of_the_setpoint_adds_fractions_of_an_rpm(harness: Harness) -> None:
    harness.enable()
    harness.cycles(0.5, ENABLE, 0.25)
    assert harness.left.servo.axis.rate == pytest.approx(GIMBAL_PER_TURN * 0.25 / 60.0, rel=0.05)


def test_setpoints_are_latched_by_the_sync(harness: Harness) -> None:
    harness.enable()
    harness.vehicle.receive(0x201, struct.pack("<Hhh", ENABLE, 200, 0))
    harness.vehicle.advance_steps(harness.config.steps_per_period)
    harness.vehicle.begin_cycle()
    assert harness.left.servo.axis.setpoint == 0.0
    harness.vehicle.receive(0x080, b"")
    assert harness.left.servo.axis.setpoint == pytest.approx(RATE)


def test_event_driven_pdos_act_at_once_and_are_answered_without_sync(harness: Harness) -> None:
    for index in (0x1400, 0x1800):
        assert harness.sdo(1, index, 2, 255, 1) >= 0
    harness.enable()
    sent = len(harness.frames(0x181))
    harness.vehicle.receive(0x201, struct.pack("<Hhh", QUICK_STOP, 0, 0))
    assert harness.left.state in (PowerState.QUICK_STOP_ACTIVE, PowerState.SWITCH_ON_DISABLED)
    harness.vehicle.advance_steps(harness.config.steps_per_period)
    harness.vehicle.begin_cycle()
    assert len(harness.frames(0x181)) == sent + 1


@pytest.mark.parametrize(("ramp_bits", "turns"), [(True, False), (False, True)])
def test_controlword_bits_4_to_6_matter_only_to_drives_that_use_them(ramp_bits: bool, turns: bool) -> None:
    harness = Harness(SimulationConfig(PlantTruth(), drives=drive_nodes(ramp_bits=ramp_bits)))
    harness.set_up()
    harness.enable()
    harness.cycles(0.3, 0x0F, RPM)
    assert (abs(harness.left.servo.axis.rate) > 0.5 * RATE) is turns


def test_halt_stops_the_drive_until_it_is_cleared(moving: Harness) -> None:
    moving.cycles(0.4, ENABLE | 0x100, RPM)
    assert abs(moving.left.servo.axis.rate) < 0.01 * RATE
    moving.cycles(0.4, ENABLE, RPM)
    assert moving.left.servo.axis.rate == pytest.approx(RATE, rel=0.02)


def test_drive_follows_setpoints_in_cyclic_synchronous_velocity_mode() -> None:
    rpdo = (("controlword", "target_velocity"),)
    harness = Harness(SimulationConfig(PlantTruth(), drives=drive_nodes(mode=9, rpdo=rpdo)))
    harness.set_up(mode=9)
    assert harness.sdo(1, 0x1600, 2) == 0x60FF0020
    for step in range(100):
        controlword = (DISABLE_VOLTAGE, SHUTDOWN, SWITCH_ON)[step // 15] if step < 45 else 0x0F
        target = round(RPM * 8192) if step > 60 else 0
        harness.vehicle.receive(0x201, struct.pack("<Hi", controlword, target))
        harness.cycle(0, rpdo=False)
    assert harness.left.servo.axis.rate == pytest.approx(RATE, rel=0.05)
    assert harness.sdo(1, 0x6061) == 9
    assert harness.statusword() & 0x100


def test_drive_without_a_mode_stands_still(harness: Harness) -> None:
    harness = Harness()
    harness.nmt(1)
    harness.enable()
    harness.cycles(0.2, ENABLE, RPM)
    assert harness.left.state is PowerState.OPERATION_ENABLED
    assert harness.left.servo.axis.setpoint == 0.0
    assert harness.sdo(1, 0x6060, 0, 3, 1) == -0x06090030


def test_speed_above_the_limit_is_clamped_and_reported(harness: Harness) -> None:
    assert harness.sdo(1, 0x6046, 2, 100) >= 0
    harness.enable()
    harness.cycles(0.3, ENABLE, RPM)
    assert harness.left.servo.axis.rate == pytest.approx(0.5 * RATE, rel=0.02)
    assert harness.statusword() & 0x800


@pytest.mark.parametrize("reaction", [1, 2, 3])
def test_drives_stop_by_themselves_without_the_masters_heartbeat(moving: Harness, reaction: int) -> None:
    """Setpoints continue without heartbeats: after the timeout, a control cycle and the stop, all axes stand still."""
    for node in (1, 2, 3):
        moving.sdo(node, 0x6007, 0, reaction, 2)
    moving.cycles(0.116, ENABLE, RPM, heartbeat=False)
    assert moving.emergencies(1) == []
    moving.cycles(0.012, ENABLE, RPM, heartbeat=False)
    assert [moving.emergencies(node) for node in (1, 2, 3)] == [[0x8130]] * 3
    assert moving.left.state in (PowerState.FAULT_REACTION_ACTIVE, PowerState.FAULT)
    moving.cycles(0.4, ENABLE, RPM, heartbeat=False)
    assert moving.left.state is PowerState.FAULT
    assert moving.left.nmt_state == "PRE-OPERATIONAL"
    for gimbal in moving.vehicle.plant.gimbals:
        assert gimbal.axis.mode is AxisMode.BRAKED
        assert gimbal.rate == pytest.approx(0.0, abs=1e-9)
    assert moving.sdo(1, 0x603F) == 0x8130
    assert moving.sdo(1, 0x1003, 1) & 0xFFFF == 0x8130


def test_heartbeat_reaction_0_only_reports_the_loss(moving: Harness) -> None:
    moving.sdo(1, 0x6007, 0, 0, 2)
    moving.sdo(1, 0x1029, 1, 1, 1)
    moving.cycles(0.3, ENABLE, RPM, heartbeat=False)
    assert moving.emergencies(1) == [0x8130]
    assert moving.left.state is PowerState.OPERATION_ENABLED


def test_heartbeat_is_not_monitored_before_the_first_one(harness: Harness) -> None:
    """CiA 301: monitoring begins with the first heartbeat."""
    harness.cycles(0.5, SHUTDOWN, heartbeat=False)
    assert harness.emergencies(1) == []


def test_missing_setpoints_stop_a_drive_with_a_deadline(moving: Harness) -> None:
    assert moving.sdo(1, 0x1400, 5, 20, 2) >= 0
    moving.cycles(0.1, ENABLE, RPM)
    moving.cycles(0.3, ENABLE, RPM, rpdo=False)
    assert moving.emergencies(1) == [0x8250]
    assert moving.emergencies(2) == []
    assert moving.left.state is PowerState.FAULT


def test_fault_is_reset_only_by_an_edge_and_the_drive_stays_disabled(moving: Harness) -> None:
    moving.cycle(ENABLE | FAULT_RESET, RPM)
    moving.left.fail(0x2310, 0x02)
    assert moving.emergencies(1) == [0x2310]
    moving.cycles(0.2, ENABLE | FAULT_RESET, RPM)
    assert moving.left.state is PowerState.FAULT
    moving.cycle(DISABLE_VOLTAGE)
    moving.cycle(FAULT_RESET)
    assert moving.left.state is PowerState.SWITCH_ON_DISABLED
    assert moving.emergencies(1) == [0x2310, 0x0000]
    assert moving.sdo(1, 0x603F) == 0
    moving.cycles(0.2, ENABLE, RPM)
    assert moving.left.state is PowerState.SWITCH_ON_DISABLED


def test_quick_stop_ramps_down_and_disables(moving: Harness) -> None:
    moving.cycle(QUICK_STOP, RPM)
    assert moving.left.state is PowerState.QUICK_STOP_ACTIVE
    moving.cycles(0.5, QUICK_STOP, RPM)
    assert moving.left.state is PowerState.SWITCH_ON_DISABLED
    assert moving.left.servo.axis.mode is AxisMode.BRAKED
    assert statuswords(moving)[-2:] == [0x07, 0x40]


def test_quick_stop_option_6_holds_at_standstill_and_can_be_resumed(moving: Harness) -> None:
    moving.sdo(1, 0x605A, 0, 6, 2)
    moving.cycles(0.5, QUICK_STOP, RPM)
    assert moving.left.state is PowerState.QUICK_STOP_ACTIVE
    assert abs(moving.left.servo.axis.rate) < 0.01 * RATE
    moving.cycles(0.3, ENABLE, RPM)
    assert moving.left.state is PowerState.OPERATION_ENABLED


def test_disabling_operation_ramps_down_first(moving: Harness) -> None:
    moving.cycle(SWITCH_ON, RPM)
    assert moving.left.state is PowerState.OPERATION_ENABLED
    moving.cycles(0.5, SWITCH_ON, RPM)
    assert moving.left.state is PowerState.SWITCHED_ON


def test_axis_coasts_after_losing_power_until_the_brake_closes(moving: Harness) -> None:
    moving.cycle(DISABLE_VOLTAGE, RPM)
    assert moving.left.servo.axis.mode is AxisMode.COASTING
    assert moving.left.servo.axis.rate > 0.5 * RATE
    moving.cycles(0.2, DISABLE_VOLTAGE)
    assert moving.left.servo.axis.mode is AxisMode.BRAKED
    assert moving.left.servo.axis.rate == pytest.approx(0.0, abs=1e-9)


def test_leaving_operational_stops_the_axis(moving: Harness) -> None:
    moving.nmt(0x80)
    assert moving.left.state is PowerState.FAULT_REACTION_ACTIVE
    sent = len(moving.frames(0x181))
    moving.cycles(0.5, ENABLE, RPM)
    assert moving.left.state is PowerState.FAULT
    assert len(moving.frames(0x181)) == sent


def test_stopped_node_answers_no_sdo(harness: Harness) -> None:
    harness.nmt(2, 1)
    before = len(harness.frames(0x581))
    harness.vehicle.receive(0x601, struct.pack("<BHB4x", 0x40, 0x1000, 0))
    assert len(harness.frames(0x581)) == before


def test_resets_of_communication_and_node_restore_their_defaults(harness: Harness) -> None:
    harness.sdo(1, 0x1017, 0, 100, 2)
    harness.nmt(130, 1)
    assert harness.frames(0x701)[-1] == b"\x00"
    assert harness.sdo(1, 0x1017) == 0
    assert harness.sdo(1, 0x6060) == 2
    harness.nmt(129, 1)
    assert harness.sdo(1, 0x6060) == 0
    assert harness.left.state is PowerState.NOT_READY_TO_SWITCH_ON


def test_heartbeat_is_sent_at_its_period(harness: Harness) -> None:
    harness.sdo(1, 0x1017, 0, 100, 2)
    start = len(harness.frames(0x701))
    harness.cycles(1.0, DISABLE_VOLTAGE)
    assert len(harness.frames(0x701)) - start == pytest.approx(10, abs=1)
    assert set(harness.frames(0x701)[start:]) == {b"\x05"}


@pytest.mark.parametrize("data", [b"", b"\x7f", b"\x7f\x00\xc8\x00\x00"])
def test_setpoint_frame_of_the_wrong_length_is_reported_and_ignored(moving: Harness, data: bytes) -> None:
    moving.vehicle.receive(0x201, data)
    assert moving.emergencies(1) == [0x8210]
    moving.cycle(ENABLE, RPM)
    assert moving.left.servo.axis.rate == pytest.approx(RATE, rel=0.02)


@pytest.mark.parametrize("data", [b"", b"\x40", b"\xff" * 8, bytes(8), b"\x60" + bytes(7), b"\xc0" * 8])
def test_malformed_sdo_and_nmt_frames_do_no_harm(harness: Harness, data: bytes) -> None:
    fresh = Harness()
    for target in (fresh, harness):
        target.vehicle.receive(0x601, data)
        target.vehicle.receive(0x000, data)
        assert target.sdo(1, 0x1000) == 0x00020192


def test_pdo_mapping_by_sdo_is_validated_and_applied(harness: Harness) -> None:
    harness.nmt(0x80)
    assert harness.sdo(1, 0x1A01, 1, 0x60410010) == -0x08000022
    assert harness.sdo(1, 0x1A01, 0, 0, 1) >= 0
    assert harness.sdo(1, 0x1A01, 1, 0x12345610) == -0x06040041
    assert harness.sdo(1, 0x1A01, 1, 0x60640010) == -0x06040041
    for place, entry in enumerate((0x60640020, 0x606C0020, 0x60410010), start=1):
        assert harness.sdo(1, 0x1A01, place, entry) >= 0
    assert harness.sdo(1, 0x1A01, 0, 3, 1) == -0x06040042
    assert harness.sdo(1, 0x1A01, 1, 0x60440010) >= 0
    assert harness.sdo(1, 0x1A01, 2, 0x60610008) >= 0
    assert harness.sdo(1, 0x1A01, 0, 2, 1) >= 0
    harness.nmt(1)
    harness.cycle(DISABLE_VOLTAGE)
    assert harness.frames(0x281)[-1] == struct.pack("<hb", 0, 2)


def test_identity_comes_from_the_eds_unless_the_vehicle_file_states_it(harness: Harness) -> None:
    assert harness.sdo(1, 0x1018, 1) == 0x00555052
    other = Harness(SimulationConfig(PlantTruth(), drives=drive_nodes(vendor_id=0x14, product_code=0x99)))
    assert other.sdo(2, 0x1018, 1) == 0x14
    assert other.sdo(2, 0x1018, 2) == 0x99


def test_controlwords_are_decoded_into_commands() -> None:
    assert [command_of(word) for word in (0x00, 0x02, 0x06, 0x07, 0x0F, 0x80)] == [
        Command.DISABLE_VOLTAGE,
        Command.QUICK_STOP,
        Command.SHUTDOWN,
        Command.SWITCH_ON,
        Command.ENABLE_OPERATION,
        Command.DISABLE_VOLTAGE,
    ]


NAMES = ("gimbal_left", "gimbal_right", "trim")


def with_fault(argument: str) -> Harness:
    harness = Harness(faults=parse_faults([argument], NAMES))
    harness.set_up()
    harness.enable()
    return harness


def test_injected_overcurrent_puts_the_drive_into_fault() -> None:
    harness = with_fault("drive_fault:gimbal_left@0.4")
    assert harness.emergencies(1) == []
    harness.cycles(0.2, ENABLE)
    assert harness.emergencies(1) == [0x2310]
    assert harness.left.state is PowerState.FAULT


def test_silent_drive_stops_itself() -> None:
    harness = with_fault("drive_silent:gimbal_left@0.4")
    harness.cycles(0.1, ENABLE, RPM)
    before = len(harness.sent)
    harness.cycles(0.6, ENABLE, RPM)
    assert not any(can_id in (0x181, 0x281, 0x081, 0x701) for _, can_id, _ in harness.sent[before + 20 :])
    assert harness.left.state is PowerState.FAULT
    assert harness.left.servo.axis.rate == pytest.approx(0.0, abs=1e-9)
    assert harness.vehicle.drives["gimbal_right"].state is PowerState.OPERATION_ENABLED


def test_restarted_drive_boots_again_disabled() -> None:
    harness = with_fault("drive_restart:gimbal_left@0.4")
    harness.cycles(1.0, ENABLE, RPM)
    assert harness.frames(0x701).count(b"\x00") == 2
    assert harness.left.nmt_state == "PRE-OPERATIONAL"
    assert harness.left.state is PowerState.SWITCH_ON_DISABLED


def test_drive_with_a_lost_heartbeat_still_sends_pdos() -> None:
    harness = Harness(faults=parse_faults(["drive_heartbeat_lost:trim@0.5"], NAMES))
    harness.set_up()
    harness.sdo(3, 0x1017, 0, 50, 2)
    harness.cycles(0.6, DISABLE_VOLTAGE)
    beats, answers = len(harness.frames(0x703)), len(harness.frames(0x183))
    harness.cycles(0.4, DISABLE_VOLTAGE)
    assert len(harness.frames(0x703)) == beats
    assert len(harness.frames(0x183)) == answers + 100


IMU_FAULTS = {
    "imu_silent": lambda first, later: not later,
    "imu_gap": lambda first, later: 85 <= len(later) <= 95,
    "imu_stuck": lambda first, later: len(set(later)) == 1 and len(set(first)) > 50,
    "imu_wrong_format": lambda first, later: not later,
    "imu_short_frames": lambda first, later: {len(data) for data in later} == {7},
    "imu_lost_frame": lambda first, later: not later,
}


@pytest.mark.parametrize("name", IMU_FAULTS)
def test_imu_faults_have_the_intended_effect_on_the_frames(name: str) -> None:
    """Seen in the last frame of each set; in the wrong format it is missing, too: 16-bit sets are one frame shorter."""
    harness = Harness(faults=parse_faults([f"{name}@0.4"], NAMES))
    harness.cycles(0.39, DISABLE_VOLTAGE)
    first = harness.frames(0x38A)
    harness.cycles(0.02, DISABLE_VOLTAGE)
    start = len(harness.frames(0x38A))
    harness.cycles(0.4, DISABLE_VOLTAGE)
    assert IMU_FAULTS[name](first, harness.frames(0x38A)[start:])


def test_fault_at_time_zero_acts_before_any_sync() -> None:
    harness = Harness(faults=parse_faults(["imu_silent@0"], NAMES))
    harness.vehicle.advance_steps(12)
    harness.vehicle.begin_cycle()
    assert harness.frames(0x18A) == []


@pytest.mark.parametrize(
    ("argument", "remedy"),
    [
        ("imu_broken@3", "imu_silent"),
        ("imu_silent", "imu_silent@5"),
        ("imu_silent@soon", "imu_silent@5"),
        ("imu_silent@-1", "imu_silent@5"),
        ("drive_fault@3", "drive_fault:gimbal_left@3"),
        ("drive_fault:nobody@3", "gimbal_right"),
        ("imu_silent:trim@3", "imu_silent@3"),
    ],
)
def test_invalid_fault_is_refused_with_the_correct_form(argument: str, remedy: str) -> None:
    with pytest.raises(UnknownFaultError) as caught:
        parse_faults([argument], NAMES)
    assert remedy in caught.value.remedy
    assert caught.value.fault == argument


def test_missing_or_unsuitable_eds_is_refused() -> None:
    nodes = drive_nodes()
    with pytest.raises(SimulationError, match=r"nowhere\.eds.*gimbal_left.*does not exist"):
        Harness(SimulationConfig(PlantTruth(), drives=(replace(nodes[0], eds="nowhere.eds"),)))
    with pytest.raises(SimulationError, match=r"cannot be read|no PDO"):
        Harness(SimulationConfig(PlantTruth(), drives=(replace(nodes[0], eds=__file__),)))


def test_drives_that_do_not_suit_a_monocab_are_refused() -> None:
    nodes = drive_nodes()
    with pytest.raises(SimulationError, match="3 gimbal drives"):
        Harness(SimulationConfig(PlantTruth(), drives=tuple(replace(node, role="gimbal") for node in nodes)))
    with pytest.raises(SimulationError, match="same node"):
        Harness(SimulationConfig(PlantTruth(), drives=(nodes[0], replace(nodes[1], node=1))))
    with pytest.raises(SimulationError, match="no object 'speed'"):
        Harness(SimulationConfig(PlantTruth(), drives=(replace(nodes[0], rpdo=(("speed",),)),)))


def test_imu_has_a_canopen_heartbeat_or_sequential_identifiers() -> None:
    harness = Harness()
    harness.cycles(2.0, DISABLE_VOLTAGE)
    assert len(harness.frames(0x70A)) == pytest.approx(3, abs=1)
    config = SimulationConfig(PlantTruth(), drives=drive_nodes())
    sequential = Harness(replace(config, imu=replace(config.imu, protocol="sequential", base_id=0x514)))
    sequential.cycles(0.1, DISABLE_VOLTAGE)
    assert {can_id for _, can_id, _ in sequential.sent if can_id >= 0x500 and can_id < 0x700} == {0x514, 0x515, 0x516}


def test_vehicle_rests_on_its_support_while_the_drives_are_off(harness: Harness) -> None:
    harness.cycles(0.5, DISABLE_VOLTAGE)
    assert math.degrees(harness.vehicle.plant.roll) == pytest.approx(4.03, abs=0.01)
