"""What a drive at run time makes of setpoints, and what it reads: measured values, emergencies, heartbeats; and its
configuration."""

from __future__ import annotations

import math
import struct
from dataclasses import replace

import pytest
from cia402_drives import COARSE, CYCLIC, GIMBAL, WORDS, controlword, drive_in, report
from hypothesis import given
from hypothesis import strategies as st

from upright.drivers.cia301 import emergency, nmt
from upright.drivers.cia301.nmt import NmtCommand, NmtState
from upright.drivers.cia402 import states
from upright.drivers.cia402.config import DriveConfig, DriveConfigError, find_eds
from upright.drivers.cia402.drive import Drive
from upright.drivers.cia402.states import State
from upright.telemetry.samples import CanFrame

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
