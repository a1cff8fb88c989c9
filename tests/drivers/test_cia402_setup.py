"""Set-up of a drive over SDO, with a canopen LocalNode made from the shipped EDS, on a virtual bus."""

from __future__ import annotations

import logging
import struct
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from random import Random
from typing import Any

import canopen
import pytest
from canopen.objectdictionary.datatypes import INTEGER32
from cia402_drives import GIMBAL

from upright.drivers.cia301.sdo_client import ATTEMPTS
from upright.drivers.cia402.config import DriveConfig, DriveConfigError, find_eds
from upright.drivers.cia402.eds import EdsError
from upright.drivers.cia402.sdo import DriveSetupError, MissingNode
from upright.drivers.cia402.setup import DriveReport, Supervision, configure
from upright.drivers.cia402.states import State

SERVO = replace(GIMBAL, name="trim", role="trim", node=3, direction=1, axis_per_turn=0.01)
SUPERVISION = Supervision(
    master_node=127, heartbeat_period=0.04, heartbeat_timeout=0.12, rpdo_timeout=0.02, cycle_period=0.004
)


class Device:
    """The drive's side: a LocalNode that displays the requested mode and switches off on command."""

    def __init__(self, network: Any) -> None:
        self.node = network.create_node(SERVO.node, str(find_eds(SERVO.eds, drive="trim")))
        self.follows = True
        self.stuck_mode: int | None = None
        self.written: list[tuple[int, int, int]] = []
        self.node.add_write_callback(self._on_write)
        self.set(0x6041, 0, 0x0250)

    @property
    def dictionary(self) -> Any:
        return self.node.object_dictionary

    def get(self, index: int, subindex: int = 0) -> int:
        value = self.dictionary.get_variable(index, subindex).decode_raw(self.node.get_data(index, subindex))
        assert isinstance(value, int)
        return value

    def set(self, index: int, subindex: int, value: int) -> None:
        variable = self.dictionary.get_variable(index, subindex)
        self.node.data_store.setdefault(index, {})[subindex] = variable.encode_raw(value)

    def lacks(self, *indices: int) -> None:
        for index in indices:
            del self.dictionary[index]

    def _on_write(self, index: int, subindex: int, od: canopen.objectdictionary.ODVariable, data: bytes) -> None:
        value = int.from_bytes(data, "little")
        self.written.append((index, subindex, value))
        if index == 0x6060:
            self.set(0x6061, 0, value if self.stuck_mode is None else self.stuck_mode)
        if index == 0x6040 and self.follows:
            self.set(0x6041, 0, 0x0250)


@contextmanager
def connected(channel: str) -> Iterator[canopen.Network]:
    network = canopen.Network()
    network.NOTIFIER_CYCLE = 0.02  # s, interval at which its thread checks whether to end
    network.connect(interface="virtual", channel=channel)
    try:
        yield network
    finally:
        network.disconnect()


@pytest.fixture
def network(request: pytest.FixtureRequest) -> Iterator[canopen.Network]:
    with connected(request.node.name) as network:
        yield network


@pytest.fixture
def device(request: pytest.FixtureRequest) -> Iterator[Device]:
    with connected(request.node.name) as network:
        yield Device(network)


def refused(network: canopen.Network, config: DriveConfig = SERVO) -> DriveSetupError:
    """The error of a set-up that must fail; it names drive, node and a remedy."""
    with pytest.raises(DriveSetupError) as caught:
        configure(network, config, SUPERVISION)
    error = caught.value
    assert (error.drive, error.node) == (config.name, config.node)
    assert f"drive {config.name!r} (node {config.node})" in str(error)
    assert error.remedy
    return error


def test_shipped_eds_loads_without_log_messages(caplog: pytest.LogCaptureFixture) -> None:
    path = str(find_eds("upright_servo.eds", drive="trim"))
    with caplog.at_level(logging.INFO):
        local, remote = canopen.LocalNode(3, path), canopen.RemoteNode(3, path)
    assert caplog.records == []
    assert remote.object_dictionary.keys() == local.object_dictionary.keys()
    for entry in local.object_dictionary.values():
        for variable in [entry] if isinstance(entry, canopen.objectdictionary.ODVariable) else entry.values():
            assert variable.readable
            assert local.get_data(variable.index, variable.subindex), f"{variable.qualname} has no value to answer with"


def test_drive_is_configured_and_reports_its_identity_and_options(network: canopen.Network, device: Device) -> None:
    report = configure(network, SERVO, SUPERVISION)
    assert device.node.nmt.state == "PRE-OPERATIONAL"
    assert device.get(0x1016, 1) == 127 << 16 | 120
    assert device.get(0x1017) == 40
    assert device.get(0x1400, 5) == 20
    assert device.get(0x6007) == 3
    assert device.get(0x6060) == 2
    assert report.state is State.SWITCH_ON_DISABLED
    assert (report.vendor_id, report.product_code) == (0x555052, 0x402)
    assert report.supported_modes == (2, 9)
    assert (report.quick_stop_option, report.stop_reaction) == (2, 3)
    assert report.watches_heartbeat
    assert report.watches_rpdos
    assert report.warnings == ()
    assert any("6007h:0" in change and "0x1 -> 0x3" in change for change in report.changes)
    assert configure(network, SERVO, SUPERVISION).changes == (), "what is right is not written again"


def test_pdo_mapping_of_the_shipped_eds_is_not_rewritten(network: canopen.Network, device: Device) -> None:
    configure(network, SERVO, SUPERVISION)
    mappings = {*range(0x1600, 0x1800), *range(0x1A00, 0x1C00)}
    assert not [entry for entry in device.written if entry[0] in mappings]


def test_mode_9_gets_its_own_mapping_and_interpolation_period(network: canopen.Network, device: Device) -> None:
    config = replace(SERVO, mode=9, rpdo=(("controlword", "target_velocity"),), stop_reaction="disable_voltage")
    for period, expected in ((0.004, (4, -3)), (0.0025, (25, -4)), (0.01, (10, -3))):
        report = configure(network, config, replace(SUPERVISION, cycle_period=period))
        assert (device.get(0x60C2, 1), device.get(0x60C2, 2)) == expected
    assert report.mode == 9
    assert report.stop_reaction == 2
    assert [device.get(0x1600, place) for place in range(3)] == [2, 0x60400010, 0x60FF0020]
    assert device.get(0x1400, 1) == 0x203


def test_different_mapping_is_rewritten_in_the_order_of_the_standard(network: canopen.Network, device: Device) -> None:
    for place, entry in enumerate((2, 0x60410010, 0x60610008)):
        device.set(0x1A00, place, entry)
    device.set(0x1800, 2, 255)
    device.set(0x1802, 1, 0x40000383)  # one TPDO too many, enabled
    device.set(0x1801, 1, 0xC0000283)  # disabled, and no remote frame allowed
    report = configure(network, SERVO, SUPERVISION)
    steps = [(index, subindex) for index, subindex, _ in device.written if index in (0x1800, 0x1A00)]
    assert steps == [
        (0x1800, 1),
        (0x1A00, 0),
        (0x1A00, 1),
        (0x1A00, 2),
        (0x1A00, 3),
        (0x1A00, 0),
        (0x1800, 2),
        (0x1800, 1),
    ]
    assert [device.get(0x1A00, place) for place in range(4)] == [3, 0x60410010, 0x606C0020, 0x60770010]
    assert (device.get(0x1800, 1), device.get(0x1800, 2)) == (0x183, 1)
    assert device.get(0x1801, 1) == 0x40000283
    assert device.get(0x1802, 1) == 0xC0000383
    assert any(change.startswith("TPDO1: carries 6041h:0 (16 bit), 606Ch:0 (32 bit)") for change in report.changes)


def test_different_mapping_that_is_read_only_is_refused(network: canopen.Network, device: Device) -> None:
    device.set(0x1A01, 1, 0x606C0020)
    device.dictionary.get_variable(0x1A01, 0).access_type = "ro"
    error = refused(network)
    assert "TPDO2 cannot be changed" in str(error)
    assert "carries 606Ch:0 (32 bit)" in str(error)
    assert "has 6064h:0 (32 bit)" in str(error)
    assert error.entry is not None
    assert error.entry.index == 0x1A01


def test_mapping_that_the_drive_silently_keeps_is_refused(network: canopen.Network, device: Device) -> None:
    device.set(0x1600, 1, 0x60420010)

    def keep(index: int, subindex: int, od: object) -> int | None:
        return 0x60420010 if (index, subindex) == (0x1600, 1) else None

    device.node.add_read_callback(keep)
    assert "RPDO1 carries 6042h:0 (16 bit)" in str(refused(network))


def test_asynchronous_rpdo_gives_a_warning_and_asynchronous_tpdo_is_refused(
    network: canopen.Network, device: Device
) -> None:
    device.set(0x1400, 2, 255)
    device.dictionary.get_variable(0x1400, 2).access_type = "ro"
    assert "a setpoint acts when it arrives" in " ".join(configure(network, SERVO, SUPERVISION).warnings)
    device.set(0x1800, 2, 255)
    device.dictionary.get_variable(0x1800, 2).access_type = "ro"
    assert "TPDO1 transmission type" in str(refused(network))


def test_more_pdos_than_the_drive_has_are_refused(network: canopen.Network, device: Device) -> None:
    device.lacks(0x1801, 0x1A01)
    assert "the drive has no TPDO2" in str(refused(network))


def test_a_missing_node(network: canopen.Network) -> None:
    requests: list[bytes] = []
    with connected("test_a_missing_node") as listener:
        listener.subscribe(0x603, lambda can_id, data, timestamp: requests.append(bytes(data)))
        error = refused(network, replace(SERVO, sdo_timeout=0.01))
        aborted = time.monotonic() + 1.0
        while not (requests and requests[-1][0] == 0x80) and time.monotonic() < aborted:
            time.sleep(0.005)
    assert isinstance(error, MissingNode)
    assert "power" in error.remedy
    assert "bit rate" in error.remedy
    assert [data[0] for data in requests] == [0x40] * ATTEMPTS + [0x80], "asked a few times, then the transfer aborted"


def test_node_that_stops_answering_during_setup_is_reported(network: canopen.Network, device: Device) -> None:

    def unplug(index: int, subindex: int, od: object, data: bytes) -> None:
        if index == 0x6060:
            device.node.network.unsubscribe(0x603)

    device.set(0x6060, 0, 9)
    device.node.add_write_callback(unplug)
    error = refused(network, replace(SERVO, sdo_timeout=0.02))
    assert not isinstance(error, MissingNode)
    assert "answered before" in str(error)
    assert "sdo_timeout" in error.remedy


@pytest.mark.parametrize(("change", "key"), [({"vendor_id": 0x9A}, "vendor_id"), ({"product_code": 7}, "product_code")])
def test_wrong_drive_at_the_node_id_is_refused_and_not_written(
    network: canopen.Network, device: Device, change: dict[str, int], key: str
) -> None:
    error = refused(network, replace(SERVO, **change))  # type: ignore[arg-type]
    assert key in str(error)
    assert error.entry is not None
    assert error.entry.index == 0x1018
    assert device.written == [], "nothing is written into a drive that is not the right one"
    right = {"vendor_id": 0x555052, "product_code": 0x402}
    configure(network, replace(SERVO, **{key: right[key]}), SUPERVISION)  # type: ignore[arg-type]


def test_device_of_another_profile_is_refused(network: canopen.Network, device: Device) -> None:
    device.set(0x1000, 0, 0x00000191)  # CiA 401, I/O
    assert "profile 401, not 402" in str(refused(network))
    assert device.written == []


def edited_eds(folder: Path, old: str, new: str) -> DriveConfig:
    text = find_eds(SERVO.eds, drive="trim").read_text()
    assert old in text
    path = folder / "other.eds"
    path.write_text(text.replace(old, new))
    return replace(SERVO, eds=str(path))


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("ProductNumber=0x00000402", "ProductNumber=0x00000403", "belongs to another device"),
        ("VendorNumber=0x00555052", "VendorNumber=0x0000026C", "belongs to another device"),
        (
            "[606C]\nParameterName=Velocity actual value\nObjectType=0x7\nDataType=0x0004",
            "[606C]\nParameterName=Velocity actual value\nObjectType=0x7\nDataType=0x0003",
            "as INTEGER16, not INTEGER32",
        ),
    ],
)
def test_mismatched_or_invalid_eds_is_refused(
    network: canopen.Network, device: Device, tmp_path: Path, old: str, new: str, words: str
) -> None:
    error = refused(network, edited_eds(tmp_path, old, new))
    assert isinstance(error, EdsError)
    assert words in str(error)
    assert error.file == tmp_path / "other.eds"
    assert "other.eds" in str(error)
    assert device.written == []


def test_object_that_the_eds_lacks_is_asked_of_the_drive(
    network: canopen.Network, device: Device, tmp_path: Path
) -> None:
    config = edited_eds(tmp_path, "[6042]", "[6142]")
    assert configure(network, config, SUPERVISION).warnings == ()
    device.lacks(0x6042)
    assert "target_velocity (6042h:0)" in str(refused(network, config))


def test_eds_may_omit_the_product_number(network: canopen.Network, device: Device, tmp_path: Path) -> None:
    config = edited_eds(tmp_path, "ProductNumber=0x00000402\n", "")
    assert configure(network, config, SUPERVISION).eds.endswith("other.eds")


def test_missing_eds_file_is_refused(network: canopen.Network) -> None:
    with pytest.raises(DriveConfigError, match=r"no file 'absent\.eds'"):
        configure(network, replace(SERVO, eds="absent.eds"), SUPERVISION)


def test_object_of_the_eds_that_the_drive_lacks_is_refused(network: canopen.Network, device: Device) -> None:
    device.lacks(0x2F15)
    error = refused(network)
    assert isinstance(error, EdsError)
    assert "target_velocity_fine (2F15h:0)" in str(error)


def test_object_with_another_length_in_the_drive_is_refused(network: canopen.Network, device: Device) -> None:
    device.dictionary.get_variable(0x6042, 0).data_type = INTEGER32
    assert "target_velocity (6042h:0): has 4 bytes in the drive, not 2" in str(refused(network))


def test_unsupported_mode_is_refused_and_not_written(network: canopen.Network, device: Device) -> None:
    device.set(0x6502, 0, 0b1_0000_0101)  # 1, 3, 9
    error = refused(network)
    assert "modes 1, 3, 9, but not mode 2" in str(error)
    assert not [entry for entry in device.written if entry[0] == 0x6060]


def test_mode_that_the_drive_does_not_adopt_is_refused(network: canopen.Network, device: Device) -> None:
    device.set(0x6060, 0, 9)
    device.stuck_mode = 0
    error = refused(network, replace(SERVO, mode_timeout=0.05))
    assert "is 0 0.05 s after mode 2 was requested" in str(error)
    assert "mode_timeout" in error.remedy


def test_value_that_does_not_read_back_is_refused(network: canopen.Network, device: Device) -> None:
    device.node.add_read_callback(lambda index, subindex, od: 1 if index == 0x1017 else None)
    error = refused(network)
    assert "producer heartbeat time (1017h:0): is still 0x1 after 0x28" in str(error)


def test_sdo_abort_of_a_write_is_reported_with_its_object(network: canopen.Network, device: Device) -> None:
    def refuse(index: int, subindex: int, od: object, data: bytes) -> None:
        if index == 0x1017:
            raise canopen.SdoAbortedError(0x06090031)

    device.node.add_write_callback(refuse)
    error = refused(network)
    assert "producer heartbeat time (1017h:0)" in str(error)
    assert "SDO abort 06090031h" in str(error)


def test_missing_optional_objects_are_reported_as_warnings(network: canopen.Network, device: Device) -> None:
    device.lacks(0x1005, 0x1014, 0x6007, 0x605A, 0x6502)
    del device.dictionary[0x1400][5]
    report: DriveReport = configure(network, SERVO, SUPERVISION)
    for words in ("1005h", "1014h", "6007h", "605Ah", "6502h", "1400h:5"):
        assert any(words in warning for warning in report.warnings), words
    assert report.stop_reaction is None
    assert report.supported_modes is None
    assert not report.watches_rpdos


def test_drive_without_heartbeat_or_rpdo_supervision_is_refused(network: canopen.Network, device: Device) -> None:
    device.lacks(0x1016)
    assert not configure(network, SERVO, SUPERVISION).watches_heartbeat
    del device.dictionary[0x1400][5]
    assert "neither the master's heartbeat" in str(refused(network))


def test_a_drive_that_is_still_enabled_is_switched_off_first(network: canopen.Network, device: Device) -> None:
    device.set(0x6041, 0, 0x0237)
    report = configure(network, SERVO, SUPERVISION)
    assert report.state is State.OPERATION_ENABLED
    assert device.written[0] == (0x6040, 0, 0)


def test_drive_that_does_not_switch_off_is_refused(network: canopen.Network, device: Device) -> None:
    device.follows = False
    device.set(0x6041, 0, 0x0237)
    slow = replace(SERVO, mode_timeout=0.05)
    assert "stays in Operation enabled after disable voltage" in str(refused(network, slow))


def test_drive_in_fault_is_configured_and_its_error_is_reported(network: canopen.Network, device: Device) -> None:
    device.set(0x6041, 0, 0x0218)
    device.set(0x603F, 0, 0x8130)
    report = configure(network, SERVO, SUPERVISION)
    assert report.error_code == 0x8130
    assert any("heartbeat or life guard lost" in warning for warning in report.warnings)
    assert not [entry for entry in device.written if entry[0] == 0x6040], "set-up resets no fault"


def test_quick_stop_without_a_ramp_gives_a_warning(network: canopen.Network, device: Device) -> None:
    device.set(0x605A, 0, 0)
    assert any("without a ramp" in warning for warning in configure(network, SERVO, SUPERVISION).warnings)


def test_sync_generation_by_the_drive_is_switched_off(network: canopen.Network, device: Device) -> None:
    device.set(0x1005, 0, 0x40000080)
    configure(network, SERVO, SUPERVISION)
    assert device.get(0x1005) == 0x80
    assert struct.unpack("<I", device.node.get_data(0x1005, 0)) == (0x80,)


class Stranger:
    """In place of a drive: answers every SDO request with what `answer` makes of it."""

    def __init__(self, network: Any, answer: Callable[[bytes], bytes]) -> None:
        def reply(can_id: int, data: bytearray, timestamp: float) -> None:
            network.send_message(0x580 + SERVO.node, answer(bytes(data)))

        network.subscribe(0x600 + SERVO.node, reply)


@pytest.fixture
def other(request: pytest.FixtureRequest) -> Iterator[canopen.Network]:
    with connected(request.node.name) as network:
        yield network


@pytest.mark.parametrize("length", range(1, 8))
def test_short_sdo_answer_is_refused_with_its_object(
    network: canopen.Network, other: canopen.Network, length: int
) -> None:
    Stranger(other, lambda request: (b"\x4b" + request[1:4] + bytes(4))[:length])
    error = refused(network, replace(SERVO, sdo_timeout=0.02))
    assert "device type (1000h:0)" in str(error)
    assert "3 other SDO answers" in str(error)


def test_endless_sdo_answer_ends(network: canopen.Network, other: canopen.Network) -> None:
    def segments(request: bytes) -> bytes:
        return b"\x40" + request[1:4] + bytes(4) if request[0] == 0x40 else bytes((request[0] & 0x10,)) + bytes(7)

    Stranger(other, segments)
    assert "bytes in the drive, not 4" in str(refused(network))


@pytest.mark.parametrize("seed", range(20))
def test_no_sdo_answer_whatever_raises_anything_but_a_set_up_error(
    network: canopen.Network, other: canopen.Network, seed: int
) -> None:
    random = Random(seed)

    def garbled(request: bytes) -> bytes:
        head = bytes((random.choice((0x43, 0x4B, 0x4F, 0x60, 0x80, 0x40, 0x41, 0x00, 0x01, random.randrange(256))),))
        return (head + request[1:4] + random.randbytes(4))[: random.choice((8, 8, 8, 8, random.randrange(9)))]

    Stranger(other, garbled)
    refused(network, replace(SERVO, sdo_timeout=0.02, mode_timeout=0.05))


@pytest.mark.parametrize(("subindex", "words"), [(3, "revision number"), (4, "serial number")])
def test_drive_that_was_exchanged_since_the_last_set_up_is_refused(
    network: canopen.Network, device: Device, subindex: int, words: str
) -> None:
    before = configure(network, SERVO, SUPERVISION)
    assert configure(network, SERVO, SUPERVISION, before).serial_number == before.serial_number
    device.set(0x1018, subindex, 0x77)
    with pytest.raises(DriveSetupError, match=rf"{words}.*0x77.*restart the service"):
        configure(network, SERVO, SUPERVISION, before)
