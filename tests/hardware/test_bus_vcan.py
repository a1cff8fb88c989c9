"""The bus on real SocketCAN: kernel timestamps, interfaces that go down and come back, a full transmit queue."""

from __future__ import annotations

import asyncio
import contextlib
import socket
import struct
import time
from collections.abc import AsyncIterator, Callable, Iterator
from itertools import pairwise
from pathlib import Path

import pytest

from upright.drivers.bus.bus import Bus, BusDown, BusError, BusGroup
from upright.drivers.bus.error_frames import ErrorClass
from upright.drivers.bus.socketcan import start_clock
from upright.telemetry.samples import CanFrame

pytestmark = pytest.mark.vcan

CHANNEL = "vcan7"
"""An interface for these tests only, so that other tests keep theirs."""

CAN_ERR_FLAG, CAN_EFF_FLAG, CAN_RTR_FLAG = 0x2000_0000, 0x8000_0000, 0x4000_0000


async def run(*command: str) -> None:
    process = await asyncio.create_subprocess_exec(*command, stderr=asyncio.subprocess.PIPE)
    _, error = await process.communicate()
    assert process.returncode == 0, f"{' '.join(command)}: {error.decode()}"


async def make_interface(name: str) -> None:
    await run("ip", "link", "add", "dev", name, "type", "vcan")
    # A vcan has no transmit queue, unless one is set before it comes up.
    await run("ip", "link", "set", name, "txqueuelen", "10", "up")


@pytest.fixture
async def interface() -> AsyncIterator[str]:
    await make_interface(CHANNEL)
    yield CHANNEL
    with contextlib.suppress(AssertionError):  # a test may have deleted it
        await run("ip", "link", "delete", "dev", CHANNEL)


class Peer:
    """Another program on the same interface: a plain blocking socket."""

    def __init__(self, channel: str) -> None:
        self._socket = socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW)
        self._socket.bind((channel,))
        self._socket.settimeout(5.0)

    def send(self, can_id: int, data: bytes = b"") -> None:
        self._socket.send(struct.pack("=IB3x8s", can_id, len(data), data))

    def receive(self) -> tuple[int, bytes]:
        can_id, length, data = struct.unpack("=IB3x8s", self._socket.recv(16))
        return can_id, data[:length]

    def close(self) -> None:
        self._socket.close()


@pytest.fixture
def peer(interface: str) -> Iterator[Peer]:
    peer = Peer(interface)
    yield peer
    peer.close()


class Connection:
    """An open bus, the frames that it delivered, and the time at which it went down."""

    def __init__(self, channel: str = CHANNEL, can_ids: list[int] | None = None) -> None:
        self.bus = Bus.open(f"socketcan:{channel}", index=1, can_ids=can_ids)
        self.frames: list[CanFrame] = []
        self.down: BusDown | None = None
        self.down_at = 0.0
        self.bus.start(self.frames.extend, self._on_down)

    def _on_down(self, down: BusDown) -> None:
        assert self.down is None
        self.down, self.down_at = down, time.monotonic()


@pytest.fixture
async def connection(interface: str) -> AsyncIterator[Connection]:
    connection = Connection(interface)
    yield connection
    connection.bus.close()


async def until(condition: Callable[[], object], what: str) -> None:
    limit = time.monotonic() + 10.0
    while not condition():
        assert time.monotonic() < limit, f"waited in vain for {what}"
        await asyncio.sleep(0.001)


async def test_frames_carry_the_kernels_receive_time(connection: Connection, peer: Peer) -> None:
    before = time.time_ns()
    for number in range(3):
        peer.send(0x18A + 0x100 * number, bytes([number] * number))
    after = time.time_ns()
    await until(lambda: len(connection.frames) == 3, "the frames")
    times = [frame.timestamp_ns for frame in connection.frames]
    assert before <= times[0] < times[1] < times[2] <= after
    assert [(frame.can_id, frame.data, frame.bus) for frame in connection.frames] == [
        (0x18A, b"", 1),
        (0x28A, b"\1", 1),
        (0x38A, b"\2\2", 1),
    ]
    assert connection.bus.statistics.received == 3


async def test_flag_bits_are_removed_from_the_id(connection: Connection, peer: Peer) -> None:
    peer.send(CAN_EFF_FLAG | 0x1234_5678, b"\1")
    peer.send(CAN_RTR_FLAG | 0x123)
    peer.send(CAN_EFF_FLAG | 0x123, b"\2")
    await until(lambda: len(connection.frames) == 3, "the frames")
    assert [(frame.can_id, frame.extended, frame.remote, frame.error) for frame in connection.frames] == [
        (0x1234_5678, True, False, False),
        (0x123, False, True, False),
        (0x123, True, False, False),
    ]


async def test_sent_frames_reach_other_programs_and_not_the_sender(connection: Connection, peer: Peer) -> None:
    connection.bus.send(0x201, b"\x0f\0")
    connection.bus.send(0x1234_5678, b"")
    assert [peer.receive(), peer.receive()] == [(0x201, b"\x0f\0"), (CAN_EFF_FLAG | 0x1234_5678, b"")]
    await asyncio.sleep(0.02)
    assert connection.frames == []


async def test_kernel_delivers_only_the_requested_ids(interface: str, peer: Peer) -> None:
    connection = Connection(interface, can_ids=[0x181, 0x182])
    for can_id in (0x181, 0x183, CAN_EFF_FLAG | 0x181, CAN_RTR_FLAG | 0x181, 0x182):
        peer.send(can_id)
    await until(lambda: len(connection.frames) >= 2, "the frames")
    await asyncio.sleep(0.02)
    assert [frame.can_id for frame in connection.frames if not frame.remote] == [0x181, 0x182]
    connection.bus.close()


async def test_flood_is_read_in_bounded_lists_and_frames_dropped_by_the_kernel_are_counted(
    connection: Connection, peer: Peer
) -> None:
    count = 4000  # more than any receive buffer that an unprivileged process gets
    for number in range(count):
        peer.send(0x100, number.to_bytes(4, "little"))
    read = -1
    while read < len(connection.frames):
        read = len(connection.frames)
        await asyncio.sleep(0.02)
    peer.send(0x101)  # the count of dropped frames arrives with the next received frame
    await until(lambda: connection.frames[-1].can_id == 0x101, "the frame after the flood")
    statistics = connection.bus.statistics
    numbers = [int.from_bytes(frame.data, "little") for frame in connection.frames[:-1]]
    assert numbers == list(range(len(numbers)))
    assert statistics.receive_dropped > 0
    assert statistics.received + statistics.receive_dropped == count + 1
    assert statistics.largest_drain <= 128


async def test_interface_going_down_is_reported_within_100_ms_without_a_busy_loop(connection: Connection) -> None:
    await run("ip", "link", "set", CHANNEL, "down")
    went_down_at = time.monotonic()
    await until(lambda: connection.down, "BusDown")
    assert connection.down is not None
    assert connection.down_at - went_down_at < 0.1
    assert connection.down.bus == f"socketcan:{CHANNEL}"
    assert "set down" in connection.down.reason

    wakeups, spent = connection.bus.statistics.wakeups, time.process_time()
    connection.bus.send(0x201, b"")
    await asyncio.sleep(0.3)
    assert connection.bus.statistics.wakeups == wakeups
    assert time.process_time() - spent < 0.1
    assert connection.bus.statistics.transmit_dropped == 1


async def test_bus_can_be_reopened_after_its_interface_was_down(interface: str, peer: Peer) -> None:
    connection = Connection()
    await run("ip", "link", "set", CHANNEL, "down")
    await until(lambda: connection.down, "BusDown")
    connection.bus.close()
    with pytest.raises(BusError, match="is down") as caught:
        Connection()
    assert f"ip link set {CHANNEL} up" in caught.value.remedy

    await run("ip", "link", "set", CHANNEL, "up")
    again = Connection()
    with contextlib.suppress(OSError):
        peer.send(0x100)  # the peer's own socket still reports that its interface was down
    peer.send(0x101, b"\1")
    await until(lambda: again.frames, "a frame")
    assert again.frames[-1].data == b"\1"
    assert again.down is None
    again.bus.close()


async def test_bus_can_be_reopened_after_its_interface_was_removed(interface: str) -> None:
    connection = Connection()
    await run("ip", "link", "delete", "dev", CHANNEL)
    removed_at = time.monotonic()
    await until(lambda: connection.down, "BusDown")
    assert connection.down_at - removed_at < 0.1
    connection.bus.close()
    with pytest.raises(BusError, match="no interface") as caught:
        Connection()
    assert f"ip link add dev {CHANNEL} type vcan" in caught.value.remedy

    await make_interface(CHANNEL)
    again, peer = Connection(), Peer(CHANNEL)
    peer.send(0x101)
    again.bus.send(0x201, b"")
    await until(lambda: again.frames, "a frame")
    assert peer.receive()[0] == 0x201
    again.bus.close()
    peer.close()


async def test_group_continues_when_one_of_two_buses_goes_down(interface: str) -> None:
    frames: list[CanFrame] = []
    downs: list[BusDown] = []
    group = BusGroup([Bus.open("socketcan:vcan0"), Bus.open(f"socketcan:{CHANNEL}", index=1)])
    group.start(frames.extend, downs.append)
    await run("ip", "link", "set", CHANNEL, "down")
    await until(lambda: downs, "BusDown")
    peer = Peer("vcan0")
    peer.send(0x18A)
    await until(lambda: frames, "a frame of the bus that is left")
    assert [down.bus for down in downs] == [f"socketcan:{CHANNEL}"]
    group.close()
    peer.close()


async def test_two_buses_are_delivered_as_one_list_in_the_order_of_reception(interface: str, peer: Peer) -> None:
    lists: list[list[CanFrame]] = []
    group = BusGroup([Bus.open("socketcan:vcan0"), Bus.open(f"socketcan:{CHANNEL}", index=1)])
    group.start(lists.append, lambda down: None)
    other = Peer("vcan0")
    for number in range(10):
        (other, peer)[number % 2].send(0x100 + number)
    await until(lambda: sum(map(len, lists)) == 10, "the frames")
    frames = lists[0]  # all were there at the first wake-up
    assert [frame.can_id for frame in frames] == [0x100 + number for number in range(10)]
    assert [frame.bus for frame in frames] == [0, 1] * 5
    group.close()
    other.close()


async def test_bus_off_takes_the_bus_down_and_lesser_errors_do_not(connection: Connection, peer: Peer) -> None:
    peer.send(CAN_ERR_FLAG | ErrorClass.CONTROLLER, bytes([0, 0x20, 0, 0, 0, 0, 130, 0]))
    peer.send(CAN_ERR_FLAG | ErrorClass.PROTOCOL | ErrorClass.BUS_ERROR, bytes([0, 0, 0x84, 0x08, 0, 0, 0, 0]))
    await until(lambda: len(connection.frames) == 2, "the error frames")
    assert connection.down is None
    assert connection.bus.last_error is not None
    assert connection.bus.last_error.text == "bit stuffing error, while transmitting in checksum; bus error"

    sent = time.monotonic()
    peer.send(CAN_ERR_FLAG | ErrorClass.BUS_OFF, bytes(8))
    await until(lambda: connection.down, "BusDown")
    assert connection.down is not None
    assert connection.down_at - sent < 0.1
    assert "bus-off" in connection.down.reason
    assert connection.bus.statistics.error_frames == 3
    assert [frame.error for frame in connection.frames] == [True] * 3


async def slow_down(frames_per_second: int) -> None:
    """Limit the interface to this many frames per second, with a transmit queue of five; a frame counts as 16 bytes."""
    await run(
        "tc", "qdisc", "replace", "dev", CHANNEL, "root",
        "tbf", "rate", f"{16 * 8 * frames_per_second}bit", "burst", "16", "limit", "80",
    )  # fmt: skip


async def test_temporarily_full_transmit_queue_loses_no_frames(connection: Connection, peer: Peer) -> None:
    await slow_down(1000)
    for number in range(20):
        connection.bus.send(0x200 + number, bytes([number]))
    received = await asyncio.to_thread(lambda: [peer.receive() for _ in range(20)])
    assert received == [(0x200 + number, bytes([number])) for number in range(20)]
    assert connection.bus.statistics.sent == 20
    assert connection.bus.statistics.transmit_retries >= 10
    assert connection.bus.statistics.transmit_dropped == 0
    assert connection.down is None


async def test_transmit_queue_that_stays_full_takes_the_bus_down(connection: Connection) -> None:
    await slow_down(2)
    begin = time.monotonic()
    for number in range(20):
        connection.bus.send(0x200 + number, b"")
    assert time.monotonic() - begin < 0.05  # sending did not wait
    await until(lambda: connection.down, "BusDown")
    assert connection.down is not None
    assert 0.05 <= connection.down_at - begin < 0.5
    assert "transmit queue stayed full" in connection.down.reason
    statistics = connection.bus.statistics
    assert statistics.sent + statistics.transmit_dropped == 20
    assert statistics.transmit_retries < 100  # one try a millisecond: no busy loop


@pytest.mark.skipif(
    "User Mode Linux" not in Path("/proc/cpuinfo").read_text(), reason="sets the clock, which only a guest may lose"
)
async def test_steps_of_the_wall_clock_reach_no_time_stamp(interface: str) -> None:
    clock = start_clock()
    bus, peer = Bus.open(f"socketcan:{interface}", clock=clock), Peer(interface)
    received: list[tuple[int, int]] = []

    def on_frames(frames: list[CanFrame]) -> None:
        now_ns = time.monotonic_ns() + clock.base_ns
        received.extend((now_ns, frame.timestamp_ns) for frame in frames)

    bus.start(on_frames, lambda down: None)
    steps = {50: 0.02, 100: 3600.0, 150: -1.0, 200: -3599.02}
    for number in range(250):
        peer.send(0x123)
        if number in steps:
            time.clock_settime(time.CLOCK_REALTIME, time.time() + steps[number])
        await asyncio.sleep(0.004)
    bus.close()
    peer.close()
    assert clock.steps == len(steps)
    assert len(received) >= 249
    assert all(later > earlier for (_, earlier), (_, later) in pairwise(received))
    assert all(-1_000_000 < now_ns - stamp_ns < 500_000_000 for now_ns, stamp_ns in received)
