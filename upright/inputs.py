"""What a user gives, for the layers below: recordings, the vehicle that made them, and a model."""

from __future__ import annotations

from collections.abc import Sequence
from os import PathLike, fspath

from upright.layers.recordings import Recorded
from upright.layers.results import ModelFile, VehicleFile, load_vehicle, started, vehicle_of, with_age
from upright.model import Model

Given = str | PathLike[str] | Model
"""A model as a user gives it: its file, its name, or itself."""


def gathered(
    recordings: Recorded | Sequence[Recorded], vehicle: str | PathLike[str] | None
) -> tuple[list[Recorded], VehicleFile | None]:
    """The recordings as a list, and the vehicle that made them: the given one, or the one that they name."""
    found = [recordings] if isinstance(recordings, Recorded) else list(recordings)
    file = vehicle_of(found) if vehicle is None else load_vehicle(fspath(vehicle))
    return ([with_age(each, file) for each in found] if file else found), file


def content(model: Given, vehicle: VehicleFile | None) -> ModelFile:
    """The content of a model, a shipped one with the values of the `vehicle`. Raises UprightError."""
    return model.file if isinstance(model, Model) else started(fspath(model), vehicle)
