"""Who sends which CAN id on the bus of the drives (predefined connection set of CiA 301): no two may share one.

A frame has no sender: two devices with one id are read as one, and where they send at the same time the bus has errors.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from upright.drivers.cia301.nmt import COMMAND_COB_ID, EMERGENCY_COB_ID, HEARTBEAT_COB_ID
from upright.drivers.cia402 import pdo
from upright.drivers.imu.layout import CANOPEN_SPACING, VALUES_PER_FRAME

SYNC_COB_ID = 0x080
SDO_ANSWER_COB_ID = 0x580
SDO_REQUEST_COB_ID = 0x600


@dataclass(frozen=True, slots=True)
class Node:
    """A drive on the bus: its node id, and how many PDOs it has in use."""

    name: str
    node: int
    rpdos: int
    tpdos: int


def owners(master_node: int, drives: Iterable[Node]) -> dict[int, str]:
    """What each CAN id carries, in words, on a bus with these drives and a master."""
    found = {
        COMMAND_COB_ID: "NMT commands",
        SYNC_COB_ID: "the SYNC",
        HEARTBEAT_COB_ID + master_node: f"this service's heartbeat (node {master_node})",
    }
    for drive in drives:
        whose = f"of drive {drive.name} (node {drive.node})"
        found[EMERGENCY_COB_ID + drive.node] = f"emergencies {whose}"
        found[SDO_ANSWER_COB_ID + drive.node] = f"SDO answers {whose}"
        found[SDO_REQUEST_COB_ID + drive.node] = f"SDO requests to drive {drive.name} (node {drive.node})"
        found[HEARTBEAT_COB_ID + drive.node] = f"the heartbeat {whose}"
        for number in range(1, drive.rpdos + 1):
            found[pdo.rpdo_cob_id(number, drive.node)] = f"setpoints (RPDO {number}) {whose}"
        for number in range(1, drive.tpdos + 1):
            found[pdo.tpdo_cob_id(number, drive.node)] = f"values (TPDO {number}) {whose}"
    return found


def imu_ids(protocol: str, base_id: int, precision: str, slots: Sequence[str]) -> tuple[int, ...]:
    """The ids of an IMU's frame set, as `drivers.imu.layout.ImuConfig` has them."""
    frames = -(-len(slots) // VALUES_PER_FRAME[precision])
    return tuple(base_id + place * (CANOPEN_SPACING if protocol == "canopen" else 1) for place in range(frames))


def free_base(frames: int, taken: Iterable[int]) -> int | None:
    """The first id from 500h on from which `frames` consecutive ids are free; None if there is none."""
    used = set(taken)
    bases = range(0x500, 0x800 - frames)
    return next((base for base in bases if used.isdisjoint(range(base, base + frames))), None)
