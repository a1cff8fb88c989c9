"""What closed the loop while a recording was made.

It is what a model's free run must be given in order to be compared with a recording of an unstable vehicle.
"""

from __future__ import annotations

from diagnosis.prediction.closed_loop_error import Loop
from telemetry.recording import Recording
from vehicles import registry
from vehicles.sections import VehicleFile


def recorded_loop(vehicle: VehicleFile, recording: Recording) -> Loop | str:
    """The loop of `recording` from the first row of its excitation on, or why it is not known, in words."""
    return registry.of(vehicle.vehicle.kind).recorded_loop(vehicle, recording)
