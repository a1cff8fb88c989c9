"""What closed the loop while a recording was made, where its kind of vehicle has a model of that.

It is what a model's free run must be given in order to be compared with a recording of an unstable vehicle.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from diagnosis.prediction.closed_loop_error import Loop
from service.monocab.recorded_loop import recorded_loop as monocab
from service.twsbr.recorded_loop import recorded_loop as twsbr
from service.vehicle_file.sections import VehicleFile
from telemetry.recording import Recording

LOOPS: dict[str, Callable[[Any, Recording], Loop | str]] = {"monocab": monocab, "twsbr": twsbr}
"""By kind of vehicle."""


def recorded_loop(vehicle: VehicleFile, recording: Recording) -> Loop | str:
    """The loop of `recording` from the first row of its excitation on, or why it is not known, in words."""
    kind = vehicle.vehicle.kind
    find = LOOPS.get(kind)
    return find(vehicle, recording) if find is not None else f"the loop of a {kind} cannot be run again yet"
