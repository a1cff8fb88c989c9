"""The available kinds of vehicle: each folder next to this file that has a `vehicle` module is one.

    registry.of("monocab").recorded_loop(vehicle, recording)

A further kind is a further folder; neither this module nor any other names a kind.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from functools import cache
from importlib import import_module
from typing import TYPE_CHECKING, Any

from upright.drivers.vehicle_io import VehicleIo
from upright.models.model import Model
from upright.telemetry.channels import ChannelTable
from upright.telemetry.errors import UprightError
from upright.telemetry.vehicle_modules import kinds_with
from upright.vehicles.contract import Kind, Models, VehicleKind
from upright.vehicles.sections import VehicleFile

if TYPE_CHECKING:
    from upright.diagnosis.prediction.closed_loop_error import Loop
    from upright.telemetry.recording import Recording


class UnknownKindError(UprightError):
    """There is no kind of vehicle of this `name`."""

    def __init__(self, name: str) -> None:
        super().__init__(f"there is no kind of vehicle {name!r}.", remedy=f"Use one of: {', '.join(names())}.")
        self.name = name


def names() -> tuple[str, ...]:
    """The names of all kinds, as in a vehicle file's `kind`."""
    return kinds_with("vehicle")


@cache
def of(name: str) -> VehicleKind:
    """The kind with this name. Raises UnknownKindError."""
    if name not in names():
        raise UnknownKindError(name)
    found = import_module(f"upright.vehicles.{name}.vehicle").KIND
    assert isinstance(found, VehicleKind)
    return found


def kind_of(vehicle: VehicleFile, io: VehicleIo) -> Kind[Any]:
    """The kind of a vehicle, with its drivers."""
    return of(vehicle.vehicle.kind).kind(vehicle, io)


def channels_of(kind: str) -> ChannelTable:
    """What is recorded of vehicles of this kind (of one of them: `recorded`). Raises UnknownKindError."""
    return of(kind).channels


def recorded(vehicle: VehicleFile) -> ChannelTable:
    """What is recorded of this vehicle: of its kind's channels those for which it has what they need."""
    every = channels_of(vehicle.vehicle.kind)
    return ChannelTable(each for each in every if not each.only_with or vehicle.has(each.only_with))


def nominal_model(kind: str) -> Model:
    """The model that a vehicle of this kind is identified with."""
    return of(kind).models().nominal


def models_of(vehicle: VehicleFile) -> Models:
    """The models of a vehicle, each with the values of its file."""
    from upright.estimators.identify.run import with_values

    known, found = vehicle.parameters, of(vehicle.vehicle.kind).models()
    nominal, *actuators = (
        with_values(each, known.values, known.deviations) for each in (found.nominal, *found.actuators)
    )
    return Models(nominal, tuple(actuators))


def measured(vehicle: VehicleFile, recordings: Sequence[Recording]) -> tuple[dict[str, float], dict[str, float]]:
    """The parameters that `recordings` of a vehicle measure themselves: values and standard deviations by name, SI."""
    found = of(vehicle.vehicle.kind).measured(vehicle, recordings)
    return {name: value for name, (value, _) in found.items()}, {name: std for name, (_, std) in found.items()}


def recorded_loop(vehicle: VehicleFile, recording: Recording) -> Loop | str:
    """What closed the loop of `recording` from the first sample of its excitation on, or why it is not known, in words.

    The free run of a model needs this loop to be comparable with a recording of an unstable vehicle. The controller is
    that of the vehicle file, designed for the parameters in the recording's metadata.
    """
    from upright.vehicles.experiment.recorded import designed_for

    with suppress(ValueError):  # values that this vehicle cannot have: then its controller is not this one
        vehicle = vehicle.with_values(designed_for(recording))
    return of(vehicle.vehicle.kind).recorded_loop(vehicle, recording)
