"""A second master on the bus: setpoints, network management, SYNC, heartbeat and SDO that are not the daemon's own.

The daemon does not receive its own frames, so each that has one of its ids is somebody else's.
"""

from __future__ import annotations

import struct
from collections.abc import Callable

from faults.bench import TO_DRIVE, Bench
from faults.fault import CONTROL_LOST, MONOCAB, NOT_FOLLOWED, STRANGER, Fault, Wanted, harmless, stopped
from upright.service.control.cycle.loop import HEARTBEAT, OPERATIONAL, SYNC
from upright.simulation.bus.drive_node import VirtualDrive
from upright.vehicles.bounds import Code

ENABLED = 0x7F
RESET_NODE, STOP_NODE, PRE_OPERATIONAL = 0x81, 0x02, 0x80
ALL_NODES = 0
READ, WRITE_1, WRITE_4 = 0x40, 0x2F, 0x23
POSITION, MODE, ACCELERATION = (0x6064, 0), (0x6060, 0), (0x6048, 1)
RUN_SHARE = 0.3


def setpoint(drive: VirtualDrive, controlword: int, share: float) -> bytes:
    """An RPDO of the drive: its target with this share of 1000 units, in the direction of the axis."""
    sizes = {"controlword": "H", "target_velocity": "h", "target_velocity_fine": "h", "target_torque": "h"}
    sizes |= {"target_voltage": "h"}
    values = {"controlword": controlword, "target_velocity_fine": 0}
    names = drive.config.rpdo[0]
    target = round(1000.0 * share) * drive.config.direction
    return struct.pack("<" + "".join(sizes[name] for name in names), *[values.get(name, target) for name in names])


def setpoints(share: float, controlword: int = ENABLED) -> Callable[[Bench], None]:
    """A second master sends setpoints after each of the daemon's own, and in each cycle."""

    def inject(bench: Bench) -> None:
        frames = {0x200 + drive.config.node: setpoint(drive, controlword, share) for drive in bench.main}
        bench.sent.append(
            lambda can_id, data: [(can_id, data), (can_id, frames[can_id])] if can_id in frames else [(can_id, data)]
        )

        def send() -> None:
            for can_id, data in frames.items():
                bench.to_daemon(can_id, data)

        bench.each_cycle.append(send)

    return inject


def one_setpoint(bench: Bench) -> None:
    """A single frame with a setpoint of our own id."""
    drive = bench.main[0]
    bench.from_stranger(0x200 + drive.config.node, setpoint(drive, ENABLED, 0.0))


def nmt(command: int, node: Callable[[Bench], int]) -> Callable[[Bench], None]:
    return lambda bench: bench.from_stranger(0x000, bytes((command, node(bench))))


def first(bench: Bench) -> int:
    return bench.main[0].config.node


def everybody(bench: Bench) -> int:
    return ALL_NODES


def second_sync(bench: Bench) -> None:
    bench.each_cycle.append(lambda: bench.from_stranger(SYNC, b""))


def second_heartbeat(bench: Bench) -> None:
    node = HEARTBEAT + bench.vehicle.control.master_node
    bench.each_cycle.append(lambda: bench.from_stranger(node, OPERATIONAL))


def second_heartbeat_and_dead(bench: Bench) -> None:
    """Somebody keeps the drives content, and nothing that the daemon sends arrives any more."""
    second_heartbeat(bench)
    bench.sent.append(lambda can_id, data: [])


def sdo(request: int, entry: tuple[int, int], value: int = 0, *, each_cycle: bool = False) -> Callable[[Bench], None]:
    """A stranger's SDO request to each drive that holds the vehicle up."""

    def inject(bench: Bench) -> None:
        def send() -> None:
            for drive in bench.main:
                bench.from_stranger(TO_DRIVE + drive.config.node, struct.pack("<BHBi", request, *entry, value))

        if each_cycle:
            bench.each_cycle.append(send)
        else:
            send()

    return inject


FAULTS: tuple[Fault, ...] = (
    stopped(
        "second_master_zero",
        "a second master sends the setpoint 0, enabled, in each cycle",
        setpoints(0.0),
        *STRANGER,
        within=CONTROL_LOST,
        why="a frame of one of our own ids that we did not send",
    ),
    stopped(
        "second_master_runs",
        "a second master runs the axes in each cycle",
        setpoints(RUN_SHARE),
        *STRANGER,
        within=CONTROL_LOST,
        why="a frame of one of our own ids that we did not send",
    ),
    stopped(
        "second_master_once",
        "a second master sends one single setpoint",
        one_setpoint,
        *STRANGER,
        or_in_order=True,
        why="who sends one will send more",
    ),
    stopped(
        "second_master_disables",
        "a second master switches the drives off in each cycle",
        setpoints(0.0, controlword=0),
        *STRANGER,
        Code.DRIVE_NOT_ENABLED,
        within=CONTROL_LOST,
    ),
    stopped(
        "nmt_reset_one",
        "another master resets a drive (NMT)",
        nmt(RESET_NODE, first),
        Code.DRIVE_RESTARTED,
        *STRANGER,
        within=CONTROL_LOST,
    ),
    stopped(
        "nmt_reset_all",
        "another master resets all nodes (NMT)",
        nmt(RESET_NODE, everybody),
        Code.DRIVE_RESTARTED,
        *STRANGER,
        within=CONTROL_LOST,
    ),
    stopped(
        "nmt_stop_all",
        "another master stops all nodes (NMT)",
        nmt(STOP_NODE, everybody),
        Code.DRIVE_SILENT,
        Code.DRIVE_EMERGENCY,
        Code.DRIVE_NOT_ENABLED,
        Wanted.DRIVE_NOT_REMOTE,
        *STRANGER,
        within=CONTROL_LOST,
    ),
    stopped(
        "nmt_pre_operational_one",
        "another master sets a drive pre-operational (NMT)",
        nmt(PRE_OPERATIONAL, first),
        Code.DRIVE_SILENT,
        Code.DRIVE_EMERGENCY,
        Code.DRIVE_NOT_ENABLED,
        Wanted.DRIVE_NOT_REMOTE,
        *STRANGER,
        within=CONTROL_LOST,
    ),
    harmless(
        "second_sync",
        "a second node sends SYNC in each cycle",
        second_sync,
        reported=True,
        or_in_order=True,
        or_stopped=STRANGER,
        why="the drives apply and report at the wrong time, which costs half a cycle",
    ),
    harmless(
        "second_heartbeat",
        "another node sends the master's heartbeat in each cycle",
        second_heartbeat,
        reported=True,
        or_in_order=True,
        or_stopped=STRANGER,
        why="the drives would no longer notice a dead master",
    ),
    stopped(
        "second_heartbeat_and_dead",
        "another node sends the master's heartbeat, and nothing that is sent arrives any more",
        second_heartbeat_and_dead,
        Code.DRIVE_SILENT,
        Code.DRIVE_EMERGENCY,
        *STRANGER,
        within=CONTROL_LOST,
        why="the drives stop by their RPDO time-out",
    ),
    harmless(
        "sdo_reads",
        "somebody reads the drives' positions by SDO in each cycle",
        sdo(READ, POSITION, each_cycle=True),
        reported=True,
        or_in_order=True,
        why="an open commissioning tool may read; who reads can write, so that the operator has to know",
    ),
    stopped(
        "sdo_writes_mode",
        "somebody writes another mode of operation to the drives by SDO",
        sdo(WRITE_1, MODE, 9),
        *STRANGER,
        *NOT_FOLLOWED,
        within=CONTROL_LOST,
        kinds=MONOCAB,
        why="an SDO request that we did not send, to a drive that holds the vehicle up",
    ),
    stopped(
        "sdo_writes_ramp",
        "somebody writes an acceleration of 10 rpm/s to the drives by SDO",
        sdo(WRITE_4, ACCELERATION, 10),
        *STRANGER,
        *NOT_FOLLOWED,
        within=CONTROL_LOST,
        kinds=MONOCAB,
        why="an SDO request that we did not send, to a drive that holds the vehicle up",
    ),
)
