"""canopen on a `Bus`: no socket and no thread of its own.

The owner of the bus passes on the frames that concern canopen (SDO responses, EMCY, heartbeat and boot-up messages, and
subscribed ids); everything else, the fast PDO traffic, costs one comparison. SDO calls wait for their response, so they
must run in a thread (`asyncio.to_thread`), while the event loop goes on delivering frames.
"""

from __future__ import annotations

from typing import Any

import canopen

from upright.drivers.bus.bus import Bus, BusError
from upright.telemetry.samples import CanFrame

SERVICES = frozenset((0x080, 0x580, 0x700))
"""Function codes (CiA 301) of EMCY, SDO response and heartbeat: a node that sends one of them becomes known."""


class _Network(canopen.Network):
    def __init__(self, bus: Bus) -> None:
        super().__init__()
        self.sending_bus: Bus | None = bus

    def send_message(self, can_id: int, data: bytes, remote: bool = False) -> None:
        """Called by canopen, from any thread."""
        if self.sending_bus is None:
            raise BusError("the CANopen link is closed.")
        if remote:
            raise BusError("remote frames are not sent.", remedy="use heartbeat instead of node guarding.")
        self.sending_bus.send_threadsafe(can_id, bytes(data))


class CanopenLink:
    """A canopen network on `bus`. `network` is for SDO and NMT calls, `nodes` lists the nodes heard so far.

    `malformed` counts frames that canopen could not read, such as an EMCY that is too short.
    """

    def __init__(self, bus: Bus) -> None:
        self.malformed = 0
        self.network: Any = _Network(bus)

    @property
    def nodes(self) -> list[int]:
        """Ids of the nodes that were heard (EMCY, SDO response, heartbeat), in the order of their appearance."""
        return list(self.network.scanner.nodes)

    def handle(self, frame: CanFrame) -> None:
        """Pass a received frame to canopen, if it concerns canopen."""
        can_id = frame.can_id
        if (can_id & 0x780 not in SERVICES and can_id not in self.network.subscribers) or frame.error or frame.remote:
            return
        try:
            self.network.notify(can_id, bytearray(frame.data), frame.timestamp_ns * 1e-9)
        except Exception:  # whatever canopen's readers make of the bytes of a stranger
            self.malformed += 1

    def close(self) -> None:
        """Send nothing more: an SDO call that still runs ends with a BusError."""
        self.network.sending_bus = None
