"""Find whether a model is that of a vehicle file, or of another machine for which there is only a model file.

A pendulum on a test bench has a model file and no vehicle file. The contents of a vehicle file (the angle of its
supports, CAD values, controller, experiments) must not be applied to it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from upright.estimators.contract import EstimationError
from upright.estimators.identify.run import with_values
from upright.models.model import Model
from upright.telemetry.channels import COMMON
from upright.telemetry.errors import RecordingError
from upright.telemetry.options import mapped, option
from upright.telemetry.recording import Recording
from upright.vehicles.file import load
from upright.vehicles.registry import measured, names, nominal_model, of, recorded_loop
from upright.vehicles.sections import VehicleFile

if TYPE_CHECKING:
    from upright.diagnosis.prediction.closed_loop_error import Loop


def vehicle_of(recordings: Sequence[Recording]) -> VehicleFile | None:
    """The shipped vehicle that says in the metadata of `recordings` that it recorded them; None if none is named there.

    Raises RecordingError if it is a vehicle with a file of the user's own, or if they are of several vehicles.
    """
    found = {(each.metadata.get("kind", ""), each.metadata.get("vehicle", "")): each.source for each in recordings}
    if len(found) > 1:
        (_, first), (_, second), *_ = found
        what = f"is of {second or 'no vehicle'}, and {next(iter(found.values()))} of {first or 'no vehicle'}"
        raise RecordingError(list(found.values())[1], "", what, remedy="Use recordings of one vehicle together.")
    for (kind, name), source in found.items():
        if kind not in names():
            return None
        file = load(kind)
        if name != file.vehicle.id:
            what = f"is of the vehicle {name}, which has a file of its own"
            raise RecordingError(source, "", what, remedy="Give this vehicle file, too.")
        return file
    return None


def is_of(model: Model, vehicle: VehicleFile | None) -> bool:
    """Whether `model` is one of this vehicle, that is, has the same balanced coordinate as the vehicle's own model."""
    if vehicle is None:
        return False
    try:
        own = nominal_model(vehicle.vehicle.kind)
    except EstimationError:
        return False
    return [joint.coordinate for joint in model.joints[:1]] == [joint.coordinate for joint in own.joints[:1]]


def as_measured(model: Model, vehicle: VehicleFile | None, recordings: Sequence[Recording]) -> Model:
    """`model` with the parameters that `recordings` measure themselves, if it is one of the vehicle."""
    if vehicle is None or not is_of(model, vehicle):
        return model
    return with_values(model, *measured(vehicle, recordings))


def refuse_foreign(recording: Recording, vehicle: VehicleFile) -> None:
    """Raises RecordingError if the recording is of another machine: by its metadata, or for want of any channel that
    only such a vehicle has."""
    kind, table = recording.metadata.get("kind", vehicle.vehicle.kind), of(vehicle.vehicle.kind).channels
    if kind != vehicle.vehicle.kind and kind in names():
        what = f"is a recording of a {kind}, not of {vehicle.vehicle.id}"
        named = option(f"--vehicle {kind}", f'vehicle="{kind}"')
        raise RecordingError(recording.source, "", what, remedy=f"{named}, or the file of the vehicle.")
    own = [each.name for each in table if each not in COMMON and not each.part]
    if not set(own) & set(recording.values):
        there = ", ".join(recording.channels.names)
        what = f"has no channel of a {vehicle.vehicle.kind}; there are {there}"
        ways = (option("--model FILE.toml", 'model="FILE.toml"'), option("--vehicle", "vehicle="))
        columns = mapped({own[0]: "COLUMN"})
        remedy = f"Name its model ({ways[0]}) or its vehicle ({ways[1]}), or its columns ({columns})."
        raise RecordingError(recording.source, "", what, remedy=remedy)


def support_of(model: Model, vehicle: VehicleFile | None) -> float | None:
    """The angle of the supports, rad; None for a machine that is not the vehicle."""
    return vehicle.support if vehicle is not None and is_of(model, vehicle) else None


def name_of(model: Model, vehicle: VehicleFile | None) -> str:
    """The subject of a report: the vehicle's id, or the model's name."""
    return vehicle.vehicle.id if vehicle is not None and is_of(model, vehicle) else model.name


def loops_of(model: Model, vehicle: VehicleFile | None, recordings: Sequence[Recording]) -> list[Loop | str]:
    """What closed the loop of each recording, or why it is not known; empty for a machine that is not the vehicle."""
    if vehicle is None or not is_of(model, vehicle):
        return []
    return [recorded_loop(vehicle, each) for each in recordings]
