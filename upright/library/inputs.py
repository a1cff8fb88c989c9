"""What a user gives, for the layers below: recordings, the vehicle that made them, and a model."""

from __future__ import annotations

from collections.abc import Sequence
from os import PathLike, fspath

from upright.library.layers.recordings import Recorded
from upright.library.layers.results import (
    EstimationError,
    ModelFile,
    VehicleFile,
    load_vehicle,
    started,
    vehicle_of,
    with_age,
)
from upright.library.model import Model

Given = str | PathLike[str] | Model
"""A model as a user gives it: its file, its name, or itself."""


def gathered(
    recordings: Recorded | Sequence[Recorded], vehicle: str | PathLike[str] | None
) -> tuple[list[Recorded], VehicleFile | None]:
    """The recordings as a list, and the vehicle that made them: the given one, or the one that they name."""
    found = [recordings] if isinstance(recordings, Recorded) else list(recordings)
    wrong = [each for each in found if not isinstance(each, Recorded)]
    if wrong or not found:
        what = f"{wrong[0]!r} is none" if wrong else "there is none"
        raise EstimationError("recordings", what, remedy="give what upright.load returns, one or a list.")
    file = vehicle_of(found) if vehicle is None else load_vehicle(fspath(vehicle))
    return ([with_age(each, file) for each in found] if file else found), file


def content(model: Given, vehicle: VehicleFile | None) -> ModelFile:
    """The content of a model, a shipped one with the values of the `vehicle`. Raises UprightError."""
    if not isinstance(model, str | PathLike | Model):
        remedy = "give a file, a name, or a Model; a result whose `model` is None says why in its text."
        raise EstimationError("model", f"{model!r} is none", remedy=remedy)
    return model.file if isinstance(model, Model) else started(fspath(model), vehicle)
