"""Set-up of drives that are busy, slow, forgetful or choosy, in simulated time. Each habit is that of a virtual drive.

A set-up is right if the drive runs as the vehicle file says: its objects are compared with those of a drive without any
habits.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import pytest
from cia402_drives import GIMBAL
from lock_step_network import LockStepNetwork
from simulated_bus import GIMBAL_PER_TURN, drive_nodes

from upright.drivers.cia402.config import DriveConfig
from upright.drivers.cia402.sdo import DriveSetupError
from upright.drivers.cia402.setup import DriveReport, Supervision, configure
from upright.simulation.bus.object_dictionary import read_number
from upright.simulation.config import SimulationConfig
from upright.simulation.drive_habits import DriveHabits, Key
from upright.simulation.monocab.truth import PlantTruth

SUPERVISION = Supervision(
    master_node=127, heartbeat_period=0.04, heartbeat_timeout=0.12, rpdo_timeout=0.02, cycle_period=0.004
)
DRIVE = replace(GIMBAL, name="gimbal_left", direction=1, axis_per_turn=GIMBAL_PER_TURN)
OTHER_MAPPING = replace(DRIVE, tpdo=(("statusword", "position_actual"), ("velocity_actual", "torque_actual")))
SET: tuple[Key, ...] = (
    *((0x1A00, place) for place in range(4)),
    *((0x1A01, place) for place in range(3)),
    *((0x1800, 1), (0x1801, 1), (0x1802, 1), (0x1600, 0), (0x1600, 1), (0x1400, 1), (0x1400, 5)),
    *((0x1016, 1), (0x1017, 0), (0x1005, 0), (0x1014, 0), (0x6007, 0), (0x6060, 0)),
)
"""What a set-up decides."""


def network(**habits: Any) -> LockStepNetwork:
    nodes = drive_nodes()
    first = replace(nodes[0], habits=DriveHabits(**habits))
    return LockStepNetwork(SimulationConfig(PlantTruth(), drives=(first, *nodes[1:])))


def objects(bus: LockStepNetwork) -> Mapping[Key, int]:
    node = bus.vehicle.drives["gimbal_left"]._node
    return {key: read_number(node, *key, -1) for key in SET if key != (0x6060, 0)} | {
        (0x6060, 0): bus.vehicle.drives["gimbal_left"].servo.image[0x6060_00]
    }


def set_up(bus: LockStepNetwork, config: DriveConfig = OTHER_MAPPING) -> DriveReport:
    return configure(bus, config, SUPERVISION, clock=bus)


@pytest.fixture(scope="module")
def right() -> Mapping[Key, int]:
    bus = network()
    set_up(bus)
    return objects(bus)


@pytest.mark.parametrize(
    "habits",
    [
        {"answer_time": 0.1},
        {"answer_time": 0.35},
        {"answer_time": 0.45},
        {"answer_time": 0.9},
        {"boot_time": 0.8},
        {"boot_time": 2.5},
        {"store_time": 0.35},
        {"store_time": 0.45, "answer_time": 0.2},
        {"store_time": 1.3},
        {"store_time": 2.2},
        {"mode_time": 4.0},
        {"mode_time": 4.0, "answer_time": 0.35},
        {"not_ready_time": 0.7},
        {"lost_answer": 7},
        {"lost_answer": 3, "answer_time": 0.1},
    ],
    ids=lambda habits: ", ".join(f"{name} {value}" for name, value in habits.items()),
)
def test_slow_drive_is_set_up_like_a_fast_one(habits: dict[str, float], right: Mapping[Key, int]) -> None:
    bus = network(**habits)
    report = set_up(bus)
    assert objects(bus) == right
    assert report.warnings == ()
    assert report.mode == bus.vehicle.drives["gimbal_left"].servo.shown_mode == 2


def test_drive_that_needs_longer_is_set_up_with_its_timeouts(right: Mapping[Key, int]) -> None:
    slow = {"answer_time": 3.5, "mode_time": 12.0}
    with pytest.raises(DriveSetupError, match="nothing answers"):
        set_up(network(**slow))
    patient = replace(OTHER_MAPPING, sdo_timeout=4.0)
    with pytest.raises(DriveSetupError, match=r"is 0 5 s after mode 2 was requested.*write mode_timeout"):
        set_up(network(**slow), patient)
    bus = network(**slow)
    set_up(bus, replace(patient, mode_timeout=15.0))
    assert objects(bus) == right


def test_late_answer_does_not_confirm_the_next_write() -> None:
    """1A00h:0 is written twice, 0 and then 2, by questions that are repeated; the second ones are lost on the bus."""
    bus = network(answer_time=1.4)
    bus.lose = lambda data: data[:5] == b"\x2f\x00\x1a\x00\x02"
    with pytest.raises(DriveSetupError, match=r"TPDO1 cannot be changed.*answered before"):
        set_up(bus)
    assert objects(bus)[0x1A00, 0] == 0


def test_what_is_right_is_not_written() -> None:
    bus = network()
    set_up(bus)
    bus.requests.clear()
    assert set_up(bus).changes == ()
    assert bus.writes == []


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ((0x1005, 0), 0x80),
        ((0x1005, 0), 0x80000080),
        ((0x1014, 0), 0x81),
        ((0x1014, 0), 0x40000081),
        ((0x1016, 1), 127 << 16 | 120),
        ((0x6007, 0), 3),
    ],
)
def test_read_only_object_that_is_right_or_harmless_is_no_matter(key: Key, value: int) -> None:
    size = 2 if key[0] == 0x6007 else 4
    bus = network(read_only=[key], initial={key: value.to_bytes(size, "little")})
    assert set_up(bus).warnings == ()
    assert key not in bus.writes


@pytest.mark.parametrize(
    ("key", "value", "words"),
    [
        ((0x1005, 0), struct.pack("<I", 0x40000080), r"COB-ID SYNC \(1005h:0\): the drive refuses writing 0x80"),
        ((0x1005, 0), struct.pack("<I", 0x81), r"COB-ID SYNC \(1005h:0\)"),
        ((0x1017, 0), struct.pack("<H", 0), r"producer heartbeat time \(1017h:0\)"),
        ((0x6007, 0), struct.pack("<h", 0), r"6007h:0\): is 0, so that the drive goes on.*takes no other value"),
    ],
)
def test_refusal_that_matters_ends_the_set_up(key: Key, value: bytes, words: str) -> None:
    with pytest.raises(DriveSetupError, match=words) as caught:
        set_up(network(read_only=[key], initial={key: value}))
    assert caught.value.remedy


@pytest.mark.parametrize(
    ("habits", "words"),
    [
        ({"read_only": [(0x1014, 0)], "initial": {(0x1014, 0): struct.pack("<I", 0x80000081)}}, "does not say why"),
        ({"read_only": [(0x1016, 1)]}, "only by missing setpoints"),
        ({"read_only": [(0x1400, 5)]}, "does not notice missing setpoints"),
    ],
)
def test_refusal_that_the_vehicle_can_do_without_is_a_warning(habits: dict[str, Any], words: str) -> None:
    (warning,) = set_up(network(**habits)).warnings
    assert words in warning
    assert "SDO abort 06010002h" in warning


@pytest.mark.parametrize(
    ("key", "step", "words"),
    [
        ((0x1017, 0), 50, ""),
        ((0x1016, 1), 50, "the drive has 128 ms in place of 120 ms"),
        ((0x1400, 5), 30, "the drive has 30 ms in place of 20 ms"),
        ((0x1400, 5), 100, "does not notice missing setpoints"),
    ],
)
def test_drive_may_round_a_time(key: Key, step: int, words: str) -> None:
    report = set_up(network(rounded={key: step}))
    assert words in " ".join(report.warnings)
    assert len(report.warnings) == bool(words)
    assert report.watches_rpdos == (step != 100)


def test_heartbeat_that_is_rounded_too_far_is_refused() -> None:
    with pytest.raises(DriveSetupError, match=r"1017h:0\): is still 0x64 after 0x28"):
        set_up(network(rounded={(0x1017, 0): 100}))


def test_drive_that_can_watch_neither_heartbeat_nor_setpoints_is_refused() -> None:
    with pytest.raises(DriveSetupError, match="neither the master's heartbeat"):
        set_up(network(read_only=[(0x1016, 1), (0x1400, 5)]))


@pytest.mark.parametrize(
    ("known", "initial", "found", "words"),
    [
        ((0, 1), 1, 1, 'reacts with 1 instead; write stop_reaction = "fault"'),
        ((0, 1), 0, 1, "reacts with 1 instead"),
        ((0, 2), 0, 2, 'reacts with 2 instead; write stop_reaction = "disable_voltage"'),
        ((0xFFFE,), 0xFFFE, -2, "reacts with -2 instead; its manual says what that is"),
        ((2, 3), 2, 3, ""),
    ],
)
def test_stop_reaction_is_one_that_the_drive_knows(
    known: tuple[int, ...], initial: int, found: int, words: str
) -> None:
    key = (0x6007, 0)
    report = set_up(network(known={key: known}, initial={key: struct.pack("<H", initial)}))
    assert report.stop_reaction == found
    assert words in " ".join(report.warnings)
    assert len(report.warnings) == bool(words)


def test_interpolation_period_in_other_units_is_not_written() -> None:
    cyclic = replace(OTHER_MAPPING, mode=9, rpdo=(("controlword", "target_velocity"),))
    same = {(0x60C2, 1): b"\x28", (0x60C2, 2): b"\xfc"}  # 40 times 0.1 ms
    bus = network(read_only=list(same), initial=same)
    assert set_up(bus, cyclic).warnings == ()
    with pytest.raises(DriveSetupError, match="60C2h"):
        set_up(network(read_only=list(same), initial={**same, (0x60C2, 1): b"\x29"}), cyclic)
