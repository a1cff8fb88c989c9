"""The control loop and the virtual vehicle without a bus between them (service.virtual.run), and what tests do to it.

Fast and deterministic, for tests of the decisions of the loop. Other tests connect the two by real buses.
"""

from __future__ import annotations

from collections.abc import Sequence

from upright.drivers.bus.bus import BusDown
from upright.service.virtual import run as virtual_run
from upright.telemetry.samples import CanFrame
from upright.vehicles.file import VehicleFile, load


class ClosedLoop(virtual_run.ClosedLoop):
    """One vehicle under control. `raw` holds every frame that was exchanged, `unclaimed` those that no driver takes."""

    def __init__(
        self, vehicle: VehicleFile | None = None, *, hide: Sequence[str] = (), faults: Sequence[str] = (), seed: int = 1
    ) -> None:
        self.raw: list[CanFrame] = []
        self.unclaimed: list[CanFrame] = []
        self.late = False
        """While set, frames that the loop sends do not arrive."""
        super().__init__(
            vehicle if vehicle is not None else load("monocab"),
            hide=hide,
            faults=faults,
            seed=seed,
            log=self.raw.append,
            unclaimed=self.unclaimed.append,
        )

    def lose_bus(self) -> None:
        self.loop.bus_down(BusDown("test bus", "the interface went down"))

    def _to_vehicle(self, can_id: int, data: bytes, timestamp_ns: int) -> None:
        if not self.late:
            super()._to_vehicle(can_id, data, timestamp_ns)
