"""The bus without SocketCAN: addresses, delivery, a full transmit queue, loss of a bus, and canopen on it."""

from __future__ import annotations

import asyncio
import os
import threading
import time
from collections.abc import Callable

import can
import canopen
import pytest
from canopen.objectdictionary import ODVariable, datatypes
from hypothesis import given, settings
from hypothesis import strategies as st

from upright.drivers.bus import bus as bus_module
from upright.drivers.bus.bus import Bus, BusDown, BusError, BusGroup
from upright.drivers.bus.error_frames import ControllerState, ErrorClass, decode
from upright.drivers.canopen_link import CanopenLink
from upright.telemetry.samples import CanFrame

MULTICAST = "udp_multicast:239.74.163.77"


class ScriptedPort:
    """A port for tests: `takes` decides whether the transmit queue accepts a frame. The test supplies received frames
    and the failure."""

    def __init__(self, takes: Callable[[], bool] = lambda: True) -> None:
        self.receive_dropped = 0
        self.reads = 0
        self.sent: list[tuple[int, bytes, int]] = []
        self.stopped = False
        self.failure: OSError | None = None
        self._takes = takes
        self._waiting: list[CanFrame] = []
        self._on_readable: Callable[[], None] = lambda: None

    def start(self, loop: asyncio.AbstractEventLoop, on_readable: Callable[[], None]) -> None:
        self._on_readable = on_readable

    def stop(self) -> None:
        self.stopped = True

    def receive(self) -> list[CanFrame]:
        self.reads += 1
        if not self._waiting and self.failure is not None:
            raise self.failure
        frames, self._waiting = self._waiting, []
        return frames

    def send(self, can_id: int, data: bytes, timestamp_ns: int) -> bool:
        if self.failure is not None:
            raise self.failure
        if not self._takes():
            return False
        self.sent.append((can_id, data, timestamp_ns))
        return True

    def close(self) -> None:
        self.stop()

    def put(self, *frames: CanFrame) -> None:
        self._waiting.extend(frames)

    def wake(self) -> None:
        self._on_readable()


class Consumer:
    """Collects what a bus delivers."""

    def __init__(self) -> None:
        self.lists: list[list[CanFrame]] = []
        self.downs: list[BusDown] = []
        self.sequence: list[str] = []

    def on_frames(self, frames: list[CanFrame]) -> None:
        self.lists.append(frames)
        self.sequence.append("frames")

    def on_down(self, down: BusDown) -> None:
        self.downs.append(down)
        self.sequence.append("down")

    @property
    def frames(self) -> list[CanFrame]:
        return [frame for frames in self.lists for frame in frames]


async def until(condition: Callable[[], object], what: str) -> None:
    """Wait for `condition`; the time limit only ends a test that has failed."""
    limit = time.monotonic() + 10.0
    while not condition():
        assert time.monotonic() < limit, f"waited in vain for {what}"
        await asyncio.sleep(0.001)


def block_the_loop() -> None:
    time.sleep(0.1)


def scripted(takes: Callable[[], bool] = lambda: True) -> tuple[ScriptedPort, Bus, Consumer]:
    port, consumer = ScriptedPort(takes), Consumer()
    bus = Bus(port, "scripted:0")
    bus.start(consumer.on_frames, consumer.on_down)
    return port, bus, consumer


# Addresses


@pytest.mark.parametrize(
    ("address", "says", "remedy"),
    [
        ("can0", "not a bus address", "IFACE:CHANNEL"),
        ("socketcan:", "not a bus address", "IFACE:CHANNEL"),
        ("", "not a bus address", "IFACE:CHANNEL"),
        ("soketcan:can0", "no interface 'soketcan'", "socketcan"),
        ("udp_multicast:192.0.2.200", "cannot be opened", "multicast address"),
        ("slcan:/dev/no-such-adapter", "cannot be opened", "serial port"),
    ],
)
def test_invalid_address_error_names_a_remedy(address: str, says: str, remedy: str) -> None:
    with pytest.raises(BusError, match=says) as caught:
        Bus.open(address)
    assert caught.value.bus == address
    assert remedy in caught.value.remedy


def test_missing_socketcan_interface_error_names_a_command_to_get_it() -> None:
    """The remedy on a kernel without CAN is a module or another interface; on a kernel with CAN it is an adapter."""
    with pytest.raises(BusError) as caught:
        Bus.open("socketcan:can17", bitrate=500_000)
    assert any(way in caught.value.remedy for way in ("modprobe can-raw", "ip link set can17 up"))


# The virtual bus


async def test_virtual_bus_keeps_the_senders_timestamps_and_has_no_echo() -> None:
    one, other = Bus.open("virtual:times", index=3), Bus.open("virtual:times")
    consumer, echo = Consumer(), Consumer()
    one.start(consumer.on_frames, consumer.on_down)
    other.start(echo.on_frames, echo.on_down)
    times = [1_000_000_000_000 + 4_000_001 * cycle for cycle in range(200)]
    for timestamp_ns in times:
        other.send(0x18A, timestamp_ns.to_bytes(8, "little"), timestamp_ns)
    await until(lambda: len(consumer.frames) == len(times), "the frames")
    assert [frame.timestamp_ns for frame in consumer.frames] == times
    assert [int.from_bytes(frame.data, "little") for frame in consumer.frames] == times
    assert {(frame.bus, frame.can_id, frame.extended) for frame in consumer.frames} == {(3, 0x18A, False)}
    assert echo.frames == []
    one.close()
    other.close()


async def test_frame_without_timestamp_gets_that_of_the_last_received_frame() -> None:
    one, other = Bus.open("virtual:stamps"), Bus.open("virtual:stamps")
    consumer, answers = Consumer(), Consumer()
    one.start(consumer.on_frames, consumer.on_down)
    other.start(answers.on_frames, answers.on_down)
    other.send(0x18A, b"", 1_000_004_000_000)
    await until(lambda: consumer.frames, "the frame")
    one.send(0x601, bytes(8))
    await until(lambda: answers.frames, "the answer")
    assert answers.frames[0].timestamp_ns == 1_000_004_000_000
    one.close()
    other.close()


async def test_only_requested_ids_are_delivered() -> None:
    one, other = Bus.open("virtual:filter", can_ids=[0x181, 0x182]), Bus.open("virtual:filter")
    consumer = Consumer()
    one.start(consumer.on_frames, consumer.on_down)
    for can_id in (0x080, 0x181, 0x381, 0x182, 0x1_0181):
        other.send(can_id, b"", 1)
    await until(lambda: len(consumer.frames) == 2, "the frames")
    assert [frame.can_id for frame in consumer.frames] == [0x181, 0x182]
    one.close()
    other.close()


async def test_flood_is_delivered_in_bounded_lists_and_the_event_loop_keeps_running() -> None:
    one, sender = Bus.open("virtual:flood"), can.Bus(channel="flood", interface="virtual", ignore_config=True)
    consumer, turns = Consumer(), 0
    one.start(consumer.on_frames, consumer.on_down)
    for number in range(1000):
        sender.send(can.Message(arbitration_id=number, is_extended_id=False, timestamp=1.0))
    block_the_loop()
    while len(consumer.frames) < 1000:
        await asyncio.sleep(0)
        turns += 1
        assert turns < 100_000
    assert [frame.can_id for frame in consumer.frames] == list(range(1000))
    assert one.statistics.largest_drain == max(map(len, consumer.lists)) <= 128
    assert turns >= 1000 // 128
    one.close()
    sender.shutdown()


async def test_closing_ends_the_thread_and_the_delivery() -> None:
    one, other = Bus.open("virtual:closing"), Bus.open("virtual:closing")
    consumer = Consumer()
    one.start(consumer.on_frames, consumer.on_down)
    other.send(0x100, b"", 1)
    one.close()
    one.send(0x101, b"")
    await asyncio.sleep(0.01)
    other.close()
    assert consumer.sequence == []
    assert one.statistics.transmit_dropped == 1
    assert not [thread for thread in threading.enumerate() if thread.name == "CAN bus"]


async def test_tap_sees_received_and_sent_frames() -> None:
    port, bus, _ = scripted()
    seen: list[CanFrame] = []
    bus.tap = seen.append
    received = CanFrame(7, 0x18A, b"\1", 0)
    port.put(received)
    port.wake()
    bus.send(0x201, b"\2", 9)
    assert seen == [received, CanFrame(9, 0x201, b"\2", 0)]


# A full transmit queue


async def test_full_transmit_queue_keeps_the_order_and_counts_retries() -> None:
    answers = iter([True, False, False, True, False])
    port, bus, consumer = scripted(lambda: next(answers, True))
    for number in range(5):
        bus.send(0x200 + number, bytes([number]), number + 1)
    assert [can_id for can_id, _, _ in port.sent] == [0x200]
    await until(lambda: len(port.sent) == 5, "the retries")
    assert port.sent == [(0x200 + number, bytes([number]), number + 1) for number in range(5)]
    assert bus.statistics.sent == 5
    assert bus.statistics.transmit_retries == 6  # four frames waited, two of them were refused a second time
    assert bus.statistics.transmit_dropped == 0
    assert consumer.downs == []


@settings(max_examples=25, deadline=None)
@given(st.lists(st.booleans(), max_size=12), st.integers(1, 20))
def test_frames_are_sent_once_and_in_order_whatever_the_queue_refuses(answers: list[bool], count: int) -> None:
    async def send_all() -> list[int]:
        script = iter(answers)
        port, bus, _ = scripted(lambda: next(script, True))
        for number in range(count):
            bus.send(number, b"")
        await until(lambda: len(port.sent) >= count, "the retries")
        return [can_id for can_id, _, _ in port.sent]

    assert asyncio.run(send_all()) == list(range(count))


async def test_a_transmit_queue_that_stays_full_takes_the_bus_down() -> None:
    port, bus, consumer = scripted(lambda: False)
    begin = time.monotonic()
    for number in range(3):
        bus.send(0x200 + number, b"")
    await until(lambda: consumer.downs, "BusDown")
    assert 0.05 <= time.monotonic() - begin < 0.5
    assert consumer.downs[0].bus == "scripted:0"
    assert "transmit queue stayed full for 50 ms" in consumer.downs[0].reason
    assert bus.statistics.transmit_dropped == 3
    assert port.stopped
    retries = bus.statistics.transmit_retries
    bus.send(0x300, b"")
    await asyncio.sleep(0.01)
    assert (bus.statistics.transmit_retries, bus.statistics.transmit_dropped, port.sent) == (retries, 4, [])
    assert len(consumer.downs) == 1


async def test_frame_that_waits_too_long_takes_the_bus_down_despite_a_moving_queue(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A bus that is too slow for its load must not deliver setpoints of growing age."""
    port, bus, consumer = scripted(lambda: False)
    clock = [100.0]
    monkeypatch.setattr(bus_module.time, "monotonic", lambda: clock[0])
    taken = iter(range(10))
    port._takes = lambda: next(taken) % 2 == 1  # every successful attempt is followed by a failing one
    for number in range(5):
        bus.send(0x200 + number, b"")
    for _ in range(3):
        clock[0] += 0.02
        bus._send_pending()
    await asyncio.sleep(0)
    assert 0 < len(port.sent) < 5
    assert "stayed full" in consumer.downs[0].reason


async def test_too_many_waiting_frames_take_the_bus_down() -> None:
    _, bus, consumer = scripted(lambda: False)
    for _ in range(bus_module.PENDING_LIMIT + 1):
        bus.send(0x200, b"")
    await asyncio.sleep(0)
    assert "256 more frames wait" in consumer.downs[0].reason
    assert bus.statistics.transmit_dropped == bus_module.PENDING_LIMIT + 1


# Loss of a bus


async def test_last_frames_are_delivered_before_a_single_bus_down() -> None:
    port, bus, consumer = scripted()
    port.put(CanFrame(1, 0x181, b""))
    port.failure = OSError(100, "the interface was set down")
    port.wake()
    port.wake()
    await asyncio.sleep(0)
    port.wake()
    await asyncio.sleep(0)
    assert consumer.sequence == ["frames", "down"]
    assert str(consumer.downs[0]) == "scripted:0 is down: the interface was set down."
    assert port.reads == 2
    with pytest.raises(BusDown):
        bus.send_threadsafe(0x601, bytes(8))


async def test_a_failing_send_takes_the_bus_down() -> None:
    port, bus, consumer = scripted()
    port.failure = OSError(100, "the interface was set down")
    bus.send(0x201, b"")
    await asyncio.sleep(0)
    assert [down.reason for down in consumer.downs] == ["the interface was set down"]
    assert bus.statistics.transmit_dropped == 1


async def test_bus_off_takes_the_bus_down_after_its_frame_was_delivered() -> None:
    port, bus, consumer = scripted()
    warning = CanFrame(1, ErrorClass.CONTROLLER, bytes([0, 0x08, 0, 0, 0, 0, 0, 0]), error=True)
    port.put(warning)
    port.wake()
    assert consumer.downs == []
    assert bus.summary()["last_error"] == "transmit error warning"
    port.put(CanFrame(2, ErrorClass.BUS_OFF | ErrorClass.COUNTERS, bytes([0, 0, 0, 0, 0, 0, 248, 3]), error=True))
    port.wake()
    await asyncio.sleep(0)
    assert consumer.sequence == ["frames", "frames", "down"]
    assert "bus-off" in consumer.downs[0].reason
    assert "248 transmit, 3 receive" in consumer.downs[0].reason
    assert bus.statistics.error_frames == 2


async def test_closed_bus_delivers_nothing_not_even_bus_down() -> None:
    port, bus, consumer = scripted()
    port.failure = OSError(19, "the interface was removed")
    port.wake()
    bus.close()
    await asyncio.sleep(0)
    assert consumer.sequence == []
    assert bus.drain() == []


# Several buses


async def test_a_group_delivers_one_list_in_the_order_of_the_timestamps() -> None:
    ports = [ScriptedPort(), ScriptedPort()]
    group = BusGroup([Bus(port, f"scripted:{index}", index) for index, port in enumerate(ports)])
    consumer = Consumer()
    group.start(consumer.on_frames, consumer.on_down)
    ports[0].put(*(CanFrame(time_ns, 0x181, b"", 0) for time_ns in (10, 40, 50)))
    ports[1].put(*(CanFrame(time_ns, 0x18A, b"", 1) for time_ns in (20, 30, 60)))
    ports[1].wake()
    ports[0].wake()  # both had become readable: the second wake-up finds and delivers nothing
    assert [[frame.timestamp_ns for frame in frames] for frames in consumer.lists] == [[10, 20, 30, 40, 50, 60]]
    group.send(1, 0x201, b"\1", 70)
    assert (ports[0].sent, ports[1].sent) == ([], [(0x201, b"\1", 70)])


async def test_group_continues_with_the_remaining_bus() -> None:
    ports = [ScriptedPort(), ScriptedPort()]
    group = BusGroup([Bus(port, f"scripted:{index}", index) for index, port in enumerate(ports)])
    consumer = Consumer()
    group.start(consumer.on_frames, consumer.on_down)
    ports[0].failure = OSError(19, "the interface was removed")
    ports[1].put(CanFrame(1, 0x18A, b"", 1))
    ports[1].wake()  # this wake-up finds that the other bus is gone
    ports[1].put(CanFrame(2, 0x18A, b"", 1))
    ports[1].wake()
    await asyncio.sleep(0)
    assert [down.bus for down in consumer.downs] == ["scripted:0"]
    assert len(consumer.frames) == 2
    assert [summary["down"] for summary in group.statistics()] == ["the interface was removed", ""]


# Other interfaces


async def test_multicast_reaches_its_own_group_and_not_the_sender() -> None:
    buses = [Bus.open(address) for address in (MULTICAST, MULTICAST, "udp_multicast:239.74.163.78")]
    consumers = [Consumer() for _ in buses]
    for bus, consumer in zip(buses, consumers, strict=True):
        bus.start(consumer.on_frames, consumer.on_down)
    before = time.time_ns()
    buses[0].send(0x18A, b"\1\2\3")
    buses[1].send(0x201, b"")
    await until(lambda: consumers[0].frames and consumers[1].frames, "both frames")
    await asyncio.sleep(0.02)
    assert [(frame.can_id, frame.data) for frame in consumers[1].frames] == [(0x18A, b"\1\2\3")]
    assert [frame.can_id for frame in consumers[0].frames] == [0x201]
    assert consumers[2].frames == []
    assert before - 1_000_000 < consumers[1].frames[0].timestamp_ns < time.time_ns() + 1_000_000
    for bus in buses:
        bus.close()


@pytest.fixture
def serial_line(monkeypatch: pytest.MonkeyPatch) -> tuple[int, Bus]:
    """A serial CAN adapter (slcan) on a pseudo-terminal: its far end, and the bus on it."""
    far, near = os.openpty()
    with monkeypatch.context() as patch:
        patch.setattr(time, "sleep", lambda seconds: None)  # skips 2 s for adapters that restart on opening
        bus = Bus.open(f"slcan:{os.ttyname(near)}", bitrate=500_000)
    os.close(near)
    return far, bus


def read_to(far: int, end: bytes) -> bytes:
    """What the adapter was sent, up to `end`: a pseudo-terminal delivers it in parts."""
    found = b""
    while not found.endswith(end):
        found += os.read(far, 100)
    return found


async def test_serial_adapter_receives_sends_and_reports_its_removal(serial_line: tuple[int, Bus]) -> None:
    far, bus = serial_line
    consumer = Consumer()
    assert b"S6\r" in read_to(far, b"O\r")  # 500 kbit/s, open
    bus.start(consumer.on_frames, consumer.on_down)
    os.write(far, b"t18A80102030405060708\rtXYZ\r\x07T0000012320A0B\r")
    await until(lambda: len(consumer.frames) == 2, "the frames")
    assert [(frame.can_id, frame.data, frame.extended) for frame in consumer.frames] == [
        (0x18A, bytes(range(1, 9)), False),
        (0x123, b"\x0a\x0b", True),
    ]
    bus.send(0x201, b"\x0f\x00")
    assert await asyncio.to_thread(read_to, far, b"t20120F00\r") in (b"t20120F00\r", b"O\rt20120F00\r")
    os.close(far)
    await until(lambda: consumer.downs, "BusDown")
    bus.close()
    assert not [thread for thread in threading.enumerate() if thread.name == "CAN bus"]


async def test_serial_line_with_invalid_data_takes_the_bus_down(serial_line: tuple[int, Bus]) -> None:
    far, bus = serial_line
    consumer = Consumer()
    bus.start(consumer.on_frames, consumer.on_down)
    os.write(far, b"t!\r" * 20)
    await until(lambda: consumer.downs, "BusDown")
    assert "not CAN" in consumer.downs[0].reason
    bus.close()
    os.close(far)


# Error frames


@pytest.mark.parametrize(
    ("can_id", "data", "state", "text"),
    [
        (0x040, b"", ControllerState.BUS_OFF, "bus-off"),
        (0x100, b"", ControllerState.ERROR_ACTIVE, "controller restarted"),
        (0x004, bytes([0, 0x0C]), ControllerState.WARNING, "receive error warning, transmit error warning"),
        (0x004, bytes([0, 0x30]), ControllerState.PASSIVE, "receive error-passive, transmit error-passive"),
        (0x004, bytes([0, 0x40]), ControllerState.ERROR_ACTIVE, "back to error-active"),
        (0x004, bytes([0, 0x01]), ControllerState.UNKNOWN, "receive buffer overflow"),
        (0x008, bytes([0, 0, 0x04, 0x0A]), ControllerState.UNKNOWN, "bit stuffing error in data"),
        (0x088, bytes([0, 0, 0x90, 0x19]), ControllerState.UNKNOWN, "acknowledge slot; bus error"),
        (0x002, bytes([11]), ControllerState.UNKNOWN, "arbitration lost in bit 11"),
        (0x020, b"", ControllerState.UNKNOWN, "no acknowledge (no other node"),
        (0x204, bytes([0, 0x20, 0, 0, 0, 0, 130, 7]), ControllerState.PASSIVE, "130 transmit, 7 receive"),
        (0x000, b"", ControllerState.UNKNOWN, "error class 000h"),
    ],
)
def test_error_frame_is_decoded_to_state_and_text(can_id: int, data: bytes, state: ControllerState, text: str) -> None:
    report = decode(CanFrame(0, can_id, data, error=True))
    assert report.state is state
    assert text in report.text
    assert (report.transmit_errors, report.receive_errors) == ((130, 7) if can_id & 0x200 else (None, None))


@given(st.integers(0, 0x1FFFFFFF), st.binary(max_size=8))
def test_every_error_frame_has_a_text(can_id: int, data: bytes) -> None:
    report = decode(CanFrame(0, can_id, data, error=True))
    assert report.text
    assert report.classes == can_id & 0x3FF


# canopen on a bus


def _dictionary() -> canopen.ObjectDictionary:
    dictionary = canopen.ObjectDictionary()
    variable = ODVariable("device type", 0x1000)
    variable.data_type, variable.access_type, variable.default = datatypes.UNSIGNED32, "ro", 0x0002_0192
    dictionary.add_object(variable)
    return dictionary


async def test_canopen_reads_a_node_over_the_link() -> None:
    far = canopen.Network().connect(interface="virtual", channel="link")
    far.create_node(3, _dictionary())
    bus = Bus.open("virtual:link")
    link = CanopenLink(bus)
    delivered: list[CanFrame] = []

    def on_frames(frames: list[CanFrame]) -> None:
        for frame in frames:
            delivered.append(frame)
            link.handle(frame)

    bus.start(on_frames, lambda down: None)
    remote = link.network.add_node(3, _dictionary())
    assert await asyncio.to_thread(lambda: remote.sdo[0x1000].raw) == 0x0002_0192
    far.send_message(0x703, b"\x7f")
    await until(lambda: remote.nmt.state == "PRE-OPERATIONAL", "the heartbeat")
    assert link.nodes == [3]

    far.send_message(0x083, b"\x10")  # an EMCY of one byte
    await until(lambda: link.malformed == 1, "the malformed EMCY")
    far.send_message(0x183, bytes(8))  # PDO traffic bypasses canopen
    await until(lambda: delivered[-1].can_id == 0x183, "the PDO")

    link.close()
    with pytest.raises(BusError, match="closed"):
        await asyncio.to_thread(lambda: remote.sdo[0x1000].raw)
    bus.close()
    far.disconnect()


async def test_sdo_over_a_lost_bus_raises_its_reason() -> None:
    port, bus, _ = scripted()
    link = CanopenLink(bus)
    remote = link.network.add_node(3, _dictionary())
    port.failure = OSError(100, "the interface was set down")
    port.wake()
    with pytest.raises(BusDown, match="set down"):
        await asyncio.to_thread(lambda: remote.sdo[0x1000].raw)
    with pytest.raises(BusError, match="remote frames"):
        link.network.send_message(0x703, b"", remote=True)
