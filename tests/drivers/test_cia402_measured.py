"""The CiA 402 driver with third-party drives: a logged boot of an Elmo drive, and EDS files of four manufacturers."""

from __future__ import annotations

import math
import re
from dataclasses import replace
from pathlib import Path

import canopen
import pytest

from upright.drivers.cia301.nmt import NmtState
from upright.drivers.cia402 import objects, pdo, states
from upright.drivers.cia402.config import DriveConfig
from upright.drivers.cia402.drive import Drive
from upright.drivers.cia402.eds import load
from upright.drivers.cia402.objects import ObjectEntry
from upright.drivers.cia402.sdo import SdoDialogue
from upright.drivers.cia402.states import State
from upright.telemetry.samples import CanFrame

pytestmark = pytest.mark.measured

LOGGED = DriveConfig(
    name="elmo",
    role="gimbal",
    node=3,
    direction=1,
    axis_per_turn=2 * math.pi,
    mode=9,
    increments_per_turn=65536,
    velocity_unit_rpm=1.0,
    rated_torque=1.0,
    rpdo=(("controlword", "target_velocity"),),
    tpdo=(("statusword",), ("position_actual", "velocity_actual")),
)
LINE = re.compile(r"\((?P<seconds>\d+)\.(?P<micros>\d{6})\) can0 (?P<id>[0-9A-F]+)#(?P<data>[0-9A-F]*)")


@pytest.fixture(scope="module")
def log(measured_data: Path) -> list[CanFrame]:
    lines = (measured_data / "can_logs" / "ros2_canopen_issue331_node3.log").read_text().splitlines()
    matches = [match for match in map(LINE.match, lines) if match]
    assert len(matches) == len(lines) == 27
    return [
        CanFrame(
            int(match["seconds"]) * 10**9 + int(match["micros"]) * 1000,
            int(match["id"], 16),
            bytes.fromhex(match["data"]),
        )
        for match in matches
    ]


class LoggedBus(canopen.Network):
    """Answers each SDO request as the drive in the log did."""

    def __init__(self, frames: list[CanFrame]) -> None:
        super().__init__()
        requests = [frame.data for frame in frames if frame.can_id == 0x603]
        answers = [frame.data for frame in frames if frame.can_id == 0x583]
        self.answers = dict(zip(requests, answers, strict=True))

    def send_message(self, can_id: int, data: bytes, remote: bool = False) -> None:
        self.notify(0x583, bytearray(self.answers[bytes(data)]), 0.0)


def test_logged_drive_boots_and_enables_as_our_state_machine_expects(log: list[CanFrame]) -> None:
    drive = Drive(LOGGED)
    seen: list[tuple[NmtState | None, State]] = []
    for frame in log:
        drive.handle(frame)
        if not seen or seen[-1] != (drive.nmt_state, drive.state):
            seen.append((drive.nmt_state, drive.state))
    assert seen == [
        (None, State.UNKNOWN),
        (NmtState.BOOT_UP, State.UNKNOWN),
        (NmtState.BOOT_UP, State.OPERATION_ENABLED),
    ]
    assert drive.statusword == 0x0237
    assert states.flags(drive.statusword) == ("voltage enabled", "remote")
    assert not drive.restarted
    assert drive.wrong_length == 0
    assert drive.statusword_timestamp_ns == 1730301035_299369000
    # The master in the log enabled the drive by SDO, with the same controlwords that our state machine sends.
    words = [int.from_bytes(frame.data[4:6], "little") for frame in log if frame.data[:4] == b"\x2b\x40\x60\x00"]
    path_up = [State.SWITCH_ON_DISABLED, State.READY_TO_SWITCH_ON, State.SWITCHED_ON]
    assert words == [states.controlword_towards(state, State.OPERATION_ENABLED) for state in path_up]


def test_answers_of_the_logged_drive_to_our_reads_are_decoded(log: list[CanFrame]) -> None:
    """Its expedited answers carry four bytes and no size, whatever the length of the object."""
    dialogue = SdoDialogue(LoggedBus(log), LOGGED)
    assert dialogue.read(objects.DEVICE_TYPE) & 0xFFFF == 402
    assert dialogue.read(objects.VENDOR_ID) == 0x9A
    assert dialogue.read(objects.PRODUCT_CODE) == 0x30135
    assert dialogue.read(objects.MODE_DISPLAY) == 3


EDS_FILES = [
    ("C5-E-2-09.eds", 0x26C, 19),
    ("Elmo.dcf", 0x9A, 19),
    ("cia402_slave.eds", 0x1A3, 17),
    ("epos4_50_15_can_ec90flat_gp52c_mile800_node1.dcf", 0xFB, 20),
]


@pytest.mark.parametrize(("name", "vendor", "at_least"), EDS_FILES)
def test_object_types_match_the_eds_files_of_real_drives(
    measured_data: Path, name: str, vendor: int, at_least: int
) -> None:
    path = measured_data / "eds_cia402" / name
    config = replace(LOGGED, eds=str(path))
    _, dictionary = load(config)
    assert dictionary.device_information.vendor_number == vendor
    entries = {entry for entry in vars(objects).values() if isinstance(entry, ObjectEntry)}
    entries |= {*pdo.tpdo_objects().values(), *pdo.rpdo_objects(9, 0).values(), *pdo.rpdo_objects(2, 0).values()}
    there = {entry: dictionary.get_variable(entry.index, entry.subindex) for entry in entries}
    wrong = [str(entry) for entry, found in there.items() if found is not None and found.data_type != entry.data_type]
    assert wrong == []
    assert sum(found is not None for found in there.values()) >= at_least
    mapped = [there[entry] for entry in config.mapped_objects]
    assert all(found is not None and found.pdo_mappable for found in mapped)


def missing(config: DriveConfig) -> list[str]:
    """What is said of the mapped objects that an EDS lacks."""
    warnings: list[str] = []
    load(config, warnings)
    return [each.partition(":")[0] for each in warnings if "is missing: the drive is asked" in each]


def test_mapping_that_a_real_data_sheet_lacks_is_said(measured_data: Path) -> None:
    """Elmo's drive has no velocity mode (2). Nanotec's has: its EDS has 6042h, but no fine part of another maker."""
    folder = measured_data / "eds_cia402"
    plain = replace(LOGGED, mode=2)
    assert missing(replace(plain, eds=str(folder / "Elmo.dcf"))) == ["[6042] (target_velocity) is missing"]
    assert missing(replace(plain, eds=str(folder / "C5-E-2-09.eds"))) == []
    fine = replace(plain, rpdo=(("controlword", "target_velocity", "target_velocity_fine"),))
    assert missing(replace(fine, eds=str(folder / "C5-E-2-09.eds"))) == ["[2F15] (target_velocity_fine) is missing"]
