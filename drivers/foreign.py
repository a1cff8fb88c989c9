"""Frames of somebody else with the ids that only this service sends: a second master on the bus of the drives.

A bus does not give us our own frames, so that whatever is received with such an id comes from another node. Two kinds
are told apart: frames that command the drives (their RPDOs, SYNC, our heartbeat, NMT), and SDO requests to them, which
change or read their set-up. Nothing here reads a clock.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from upright.drivers.cia301.nmt import COMMAND_COB_ID, HEARTBEAT_COB_ID, NmtCommand
from upright.drivers.cia402.drive import Drive
from upright.telemetry.samples import CanFrame

SYNC_COB_ID = 0x080
SDO_REQUEST_COB_ID = 0x600

QUIET_NS = 5_000_000_000
"""Silence after which a stranger counts as gone: somebody who configures a drive by hand may have sent one frame."""

REMEDY = "disconnect the other CANopen master, or end its program"


@dataclass(slots=True)
class OwnId:
    """An id that only this service uses, what it carries in words, and what was received with it."""

    can_id: int
    carries: str
    commands: bool
    """Whether its frames command the drives; else they are SDO requests."""
    count: int = 0
    last_ns: int = 0
    data: bytes = b""

    @property
    def text(self) -> str:
        """Whose id it is, and what somebody else does with it."""
        what = self.carries
        if self.can_id == COMMAND_COB_ID and len(self.data) == 2:
            name = next((each.name for each in NmtCommand if each.value == self.data[0]), f"{self.data[0]:02X}h")
            node = f"node {self.data[1]}" if self.data[1] else "all nodes"
            what = f"an NMT command ({name.lower().replace('_', ' ')}, {node})"
        return f"somebody else on the bus sends frame {self.can_id:03X}h, {what}, which is this service's alone"


class ForeignTraffic:
    """What was received with the ids of this service, which sends to `drives` and is the node `master_node`.

    `command` and `request` are the first frame of each kind since `forget`, None if there was none.
    """

    def __init__(self, drives: Sequence[Drive], master_node: int) -> None:
        self.command: OwnId | None = None
        self.request: OwnId | None = None
        self._ids = {
            COMMAND_COB_ID: OwnId(COMMAND_COB_ID, "an NMT command", commands=True),
            SYNC_COB_ID: OwnId(SYNC_COB_ID, "the SYNC", commands=True),
            HEARTBEAT_COB_ID + master_node: OwnId(
                HEARTBEAT_COB_ID + master_node, f"the master's heartbeat (node {master_node})", commands=True
            ),
        }
        for drive in drives:
            whose = f"drive {drive.config.name} (node {drive.config.node})"
            for number, can_id in enumerate(drive.config.rpdo_codecs, start=1):
                self._ids[can_id] = OwnId(can_id, f"setpoints (RPDO {number}) of {whose}", commands=True)
            can_id = SDO_REQUEST_COB_ID + drive.config.node
            self._ids[can_id] = OwnId(can_id, f"an SDO request to {whose}", commands=False)

    @property
    def can_ids(self) -> tuple[int, ...]:
        """The ids of this service."""
        return tuple(self._ids)

    def handle(self, frame: CanFrame) -> None:
        """Take one received frame with one of `can_ids`. Those on another bus than the drives' mean something else."""
        if frame.bus != 0:
            return
        own = self._ids[frame.can_id]
        own.count += 1
        own.last_ns = frame.timestamp_ns
        own.data = frame.data
        if own.commands:
            self.command = self.command or own
        else:
            self.request = self.request or own

    def forget(self) -> None:
        """Begin again, with a new experiment; the counts go on."""
        self.command = self.request = None

    def active(self, now_ns: int) -> list[OwnId]:
        """The ids with which somebody else has sent within the last seconds."""
        return [own for own in self._ids.values() if own.count and now_ns - own.last_ns < QUIET_NS]

    def statistics(self) -> list[dict[str, int | str]]:
        """The frames so far, by id, for `upright status`."""
        return [
            {"id": f"{own.can_id:03X}h", "carries": own.carries, "frames": own.count}
            for own in self._ids.values()
            if own.count
        ]
