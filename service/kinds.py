"""The kinds of vehicle that there are, by the name that a vehicle file gives as `kind`.

    kind = kinds.of(vehicle, io)

A further kind is an entry here, one in `service.vehicle_file.file`, a channel table, and a package like
`service.twsbr`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from drivers.vehicle_io import VehicleIo
from service.kind import Kind
from service.monocab.kind import Monocab
from service.twsbr.kind import Twsbr
from service.vehicle_file.file import VehicleFile

KINDS: dict[str, Callable[[Any, VehicleIo], Kind[Any]]] = {"monocab": Monocab, "twsbr": Twsbr}
"""What makes a kind of its own vehicle file and drivers."""


def of(vehicle: VehicleFile, io: VehicleIo) -> Kind[Any]:
    """The kind of a vehicle, with its drivers."""
    return KINDS[vehicle.vehicle.kind](vehicle, io)
