"""The inverters of flywheels on the bus: each reports its speed at a period of its own, and takes no commands there."""

from __future__ import annotations

import struct
from collections.abc import Sequence

from upright.simulation.config import SpeedNode

LAYOUTS = {"int16": struct.Struct("<h"), "int32": struct.Struct("<i")}
FRAME = 8


class SpeedReports:
    """The reports of all of them. `silent`: they are cut off the bus, one flag each."""

    def __init__(self, nodes: Sequence[SpeedNode]) -> None:
        self._nodes = nodes
        self._due = [place * node.period / max(len(nodes), 1) for place, node in enumerate(nodes)]
        self.silent = [False] * len(nodes)

    def frames(self, now: float, speeds: Sequence[float]) -> list[tuple[int, bytes]]:
        """The frames that are due at `now` (s), for the flywheels' `speeds` (rad/s)."""
        found = []
        for place, node in enumerate(self._nodes):
            if now < self._due[place]:
                continue
            self._due[place] += node.period
            if self.silent[place]:
                continue
            layout = LAYOUTS[node.layout]
            most = 1 << (8 * layout.size - 1)
            count = max(-most, min(most - 1, round(speeds[place] / node.unit)))
            data = bytearray(min(FRAME, node.start_byte + layout.size))
            layout.pack_into(data, node.start_byte, count)
            found.append((node.can_id, bytes(data)))
        return found
