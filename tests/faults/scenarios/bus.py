"""Faults of the bus: frames that are lost, doubled or out of order, a babbling node, bus-off, error frames."""

from __future__ import annotations

import random
from collections.abc import Callable, Collection

from faults.bench import Bench
from faults.fault import CONTROL_LOST, NOT_FOLLOWED, Fault, Wanted, harmless, stopped
from upright.drivers.bus.bus import BusDown
from upright.drivers.bus.error_frames import ErrorClass
from upright.service.control.cycle.loop import HEARTBEAT, SYNC
from upright.telemetry.samples import CanFrame
from upright.vehicles.bounds import Code

SILENT = (Code.IMU_SILENT, Code.DRIVE_SILENT, Code.DRIVE_EMERGENCY)
"""What a bus that loses frames is stopped for."""
RUBBISH = (0x001, 0x010, 0x07E, 0x100, 0x555)
"""Ids that no node of a vehicle has."""
FULL_LOAD = 8
"""Frames per ms of 1 Mbit/s."""
ADDRESS = "socketcan:can0"


def lost(share: float, *, received: bool = True, sent: bool = True, seed: int = 5) -> Callable[[Bench], None]:
    """This share of all frames is lost."""

    def inject(bench: Bench) -> None:
        draw = random.Random(seed)
        if received:
            bench.received.append(lambda frame: [] if draw.random() < share else [frame])
        if sent:
            bench.sent.append(lambda can_id, data: [] if draw.random() < share else [(can_id, data)])

    return inject


def without(ids: Callable[[Bench], Collection[int]]) -> Callable[[Bench], None]:
    """These frames do not reach the vehicle."""

    def inject(bench: Bench) -> None:
        missing = ids(bench)
        bench.sent.append(lambda can_id, data: [] if can_id in missing else [(can_id, data)])

    return inject


def everything_twice(bench: Bench) -> None:
    bench.received.append(lambda frame: [frame, frame])
    bench.sent.append(lambda can_id, data: [(can_id, data)] * 2)


def shuffled(bench: Bench) -> None:
    """The frames of each IMU set and of the drives' answers come in random order."""
    draw, waiting = random.Random(9), list[CanFrame]()

    def through(frame: CanFrame) -> list[CanFrame]:
        waiting.append(frame)
        if len(waiting) < 3:
            return []
        frames = list(waiting)
        waiting.clear()
        draw.shuffle(frames)
        return frames

    bench.received.append(through)


def cut(bench: Bench) -> None:
    bench.received.append(lambda frame: [])
    bench.sent.append(lambda can_id, data: [])


def interface_down(bench: Bench) -> None:
    cut(bench)
    bench.loop.bus_down(BusDown(ADDRESS, "the interface was set down"))


def bus_off(bench: Bench) -> None:
    """The daemon's controller goes bus-off: an error frame, what `Bus` makes of it, and then nothing."""
    cut(bench)
    bench.to_daemon(ErrorClass.BUS_OFF | ErrorClass.CONTROLLER, bytes(8), error=True)
    bench.loop.bus_down(BusDown(ADDRESS, "the controller went bus-off"))


def bus_off_unreported(bench: Bench) -> None:
    """A driver without error frames: the controller is bus-off, and nobody says so."""
    cut(bench)


def each_cycle(bench: Bench, count: int, send: Callable[[], None]) -> None:
    """`send` so many frames in each cycle."""

    def burst() -> None:
        for _ in range(count):
            send()

    bench.each_cycle.append(burst)


def error_frames(bench: Bench) -> None:
    """Twenty error frames in each cycle, as from a bad termination, and every 50th frame is lost."""
    lost(0.02)(bench)
    each_cycle(bench, 20, lambda: bench.to_daemon(ErrorClass.PROTOCOL | ErrorClass.BUS_ERROR, bytes(8), error=True))


def rubbish(bench: Bench) -> None:
    """Four frames of ids that nobody has, in each cycle."""
    draw = random.Random(2)
    each_cycle(bench, 4, lambda: bench.from_stranger(draw.choice(RUBBISH), draw.randbytes(8)))


def long_frames(bench: Bench) -> None:
    """A stranger sends frames of 64 bytes, as CAN FD has them, under an id of the IMU."""
    each_cycle(bench, 1, lambda: bench.to_daemon(bench.imu_ids[0], bytes(64)))


def extended_ids(bench: Bench) -> None:
    """A stranger sends frames whose ids of 29 bits look like those of the IMU and of a drive."""
    for can_id in (bench.imu_ids[0], 0x180 + bench.main[0].config.node):
        each_cycle(bench, 1, lambda can_id=can_id: bench.to_daemon(can_id, bytes(8), extended=True))  # type: ignore[misc]


def babble(bench: Bench) -> None:
    """A node with the highest priority sends without a pause: nobody else gets a frame through."""
    cut(bench)
    each_cycle(bench, round(FULL_LOAD * 1e3 * bench.vehicle.period), lambda: bench.to_daemon(0x001, bytes(8)))


def first_setpoint(bench: Bench) -> tuple[int, ...]:
    node = bench.main[0].config.node
    return tuple(0x200 + 0x100 * place + node for place in range(4))


def heartbeat(bench: Bench) -> tuple[int, ...]:
    return (HEARTBEAT + bench.vehicle.control.master_node,)


FAULTS: tuple[Fault, ...] = (
    harmless("loss_0.1", "0.1 % of all frames are lost", lost(0.001)),
    *(
        harmless(
            f"loss_{share * 100:g}{f'_{seed}' if seed > 5 else ''}",
            f"{share * 100:g} % of all frames are lost, sequence {seed}",
            lost(share, seed=seed),
            why="single frames are what a model bridges, and 1 % is what a running bus may lose",
        )
        for share in (0.003, 0.01)
        for seed in (5, 11, 12)
    ),
    stopped(
        "loss_10",
        "10 % of all frames are lost",
        lost(0.1),
        *SILENT,
        or_in_order=True,
        within=0.5,
        why="100 ms of it are some 20 lost frames of 250, in which nothing need be missing twice; half a second is "
        "more than by chance",
    ),
    harmless(
        "loss_sent_10",
        "10 % of the sent frames are lost",
        lost(0.1, received=False),
        or_in_order=True,
        or_stopped=SILENT,
        why="a lost SYNC makes all drives miss one cycle, and the next one carries the same setpoint",
    ),
    stopped("loss_sent_50", "half of the sent frames are lost", lost(0.5, received=False), *SILENT, or_in_order=True),
    stopped("sent_dead", "nothing that is sent arrives", lost(1.0, received=False), *SILENT, within=CONTROL_LOST),
    stopped(
        "setpoints_lost_one",
        "the setpoints of one drive do not arrive",
        without(first_setpoint),
        *NOT_FOLLOWED,
        Code.DRIVE_EMERGENCY,
        within=0.15,
        why="the drive itself notices after its RPDO time-out of 120 ms; it keeps its last setpoint until then",
    ),
    stopped("sync_lost", "the SYNC does not arrive", without(lambda bench: (SYNC,)), *SILENT, within=CONTROL_LOST),
    stopped(
        "master_heartbeat_lost",
        "the master's heartbeat does not arrive",
        without(heartbeat),
        Code.DRIVE_EMERGENCY,
        Code.DRIVE_NOT_ENABLED,
        within=0.15,
        why="the drives notice it after their consumer time of 120 ms, and stop",
    ),
    harmless(
        "everything_twice",
        "every frame comes twice, both ways",
        everything_twice,
        why="the second one is dropped",
    ),
    harmless(
        "everything_shuffled",
        "neighbouring frames come in random order",
        shuffled,
        or_in_order=True,
        or_stopped=SILENT,
        why="sets that are out of order are none; too many of them are a silent IMU",
    ),
    stopped("interface_down", "the interface is set down", interface_down, Wanted.BUS_DOWN, within=CONTROL_LOST),
    stopped("bus_off", "the daemon's controller goes bus-off", bus_off, Wanted.BUS_DOWN, within=CONTROL_LOST),
    stopped(
        "bus_off_unreported",
        "the daemon's controller goes bus-off, and its driver does not say so",
        bus_off_unreported,
        *SILENT,
        within=CONTROL_LOST,
    ),
    harmless(
        "error_frames",
        "twenty error frames in each cycle, and 2 % of all frames are lost",
        error_frames,
        reported=True,
        or_in_order=True,
        or_stopped=SILENT,
    ),
    harmless(
        "rubbish",
        "a stranger sends four frames of unused ids in each cycle",
        rubbish,
        reported=True,
        or_in_order=True,
        why="somebody is on the bus who does not belong there, and the operator has to know who",
    ),
    harmless(
        "long_frames",
        "a stranger sends CAN FD frames of 64 bytes under an id of the IMU",
        long_frames,
        reported=True,
        or_in_order=True,
        or_stopped=(Code.IMU_FORMAT, Code.IMU_SILENT, Wanted.FOREIGN_MASTER),
        why="they are dropped for their length; that two nodes have one id, the operator has to know",
    ),
    harmless(
        "extended_ids",
        "a stranger sends frames with 29-bit ids that look like our own",
        extended_ids,
        reported=True,
        or_in_order=True,
    ),
    stopped("babble", "a node of the highest priority fills the bus", babble, *SILENT, within=CONTROL_LOST),
)
