"""From the layers: recordings and vehicle files."""

from __future__ import annotations

from service.offline.machine import vehicle_of
from service.offline.read import read
from service.offline.replay import with_age
from telemetry.errors import RecordingError
from telemetry.recording import Recording as Recorded
from telemetry.recording import describe, instants
from vehicles.file import load as load_vehicle
from vehicles.sections import VehicleFile

__all__ = [
    "Recorded",
    "RecordingError",
    "VehicleFile",
    "describe",
    "instants",
    "load_vehicle",
    "read",
    "vehicle_of",
    "with_age",
]
