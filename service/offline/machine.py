"""Find whether a model is that of a vehicle file, or of another machine for which there is only a model file.

A pendulum on a test bench has a model file and no vehicle file. The contents of a vehicle file (the angle of its
supports, CAD values, controller, experiments) must not be applied to it.
"""

from __future__ import annotations

from estimators.contract import EstimationError
from models.model import Model
from telemetry.channels import COMMON
from telemetry.errors import RecordingError
from telemetry.recording import Recording
from vehicles import registry
from vehicles.registry import nominal_model
from vehicles.sections import VehicleFile


def is_of(model: Model, vehicle: VehicleFile) -> bool:
    """Whether `model` is one of this vehicle, that is, has the same balanced coordinate as the vehicle's own model."""
    try:
        own = nominal_model(vehicle.vehicle.kind)
    except EstimationError:
        return False
    return [joint.coordinate for joint in model.joints[:1]] == [joint.coordinate for joint in own.joints[:1]]


def refuse_foreign(recording: Recording, vehicle: VehicleFile) -> None:
    """Raises RecordingError if the recording is of another machine: by its metadata, or for want of any channel that
    only such a vehicle has."""
    kind, table = recording.metadata.get("kind", vehicle.vehicle.kind), registry.of(vehicle.vehicle.kind).channels
    if kind != vehicle.vehicle.kind and kind in registry.names():
        what = f"is a recording of a {kind}, not of {vehicle.vehicle.id}"
        raise RecordingError(recording.source, "", what, remedy=f"--vehicle {kind}, or the file of the vehicle.")
    own = [each.name for each in table if each not in COMMON and not each.part]
    if not set(own) & set(recording.values):
        there = ", ".join(recording.channels.names)
        what = f"has no channel of a {vehicle.vehicle.kind}; there are {there}"
        remedy = (
            f"Name its model (--model FILE.toml) or its vehicle (--vehicle), or its columns (--map {own[0]}=COLUMN)."
        )
        raise RecordingError(recording.source, "", what, remedy=remedy)


def support_of(model: Model, vehicle: VehicleFile) -> float | None:
    """The angle of the supports, rad; None for a machine that is not the vehicle."""
    return vehicle.support if is_of(model, vehicle) else None


def name_of(model: Model, vehicle: VehicleFile) -> str:
    """The subject of a report: the vehicle's id, or the model's name."""
    return vehicle.vehicle.id if is_of(model, vehicle) else model.name
