"""Models and effects by their names on the command line: the vehicle's own with CAD values, shipped ones, or files."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from estimators.identify.run import with_values
from models.effect import Effect
from models.effects.catalogue import find
from models.file.model_file import load_model, read
from models.file.own_effects import load_effect
from models.model import Model
from telemetry.tables.mapping import Source, columns_of
from vehicles.file import VehicleFile
from vehicles.registry import nominal_model

SUFFIXES = (".toml", ".py")
"""Suffixes of files with an effect of one's own."""


def identified_model(name: str | None, vehicle: VehicleFile) -> Model:
    """A model file unchanged, or a shipped model (by default the vehicle's) with the CAD values of the vehicle file.

    Raises ModelError, EstimationError.
    """
    if name is not None and name.endswith(".toml"):
        return load_model(name)
    model = nominal_model(vehicle.vehicle.kind) if name is None else load_model(name)
    return with_values(model, vehicle.parameters.values, vehicle.parameters.deviations)


def columns(name: str | None) -> dict[str, Source]:
    """The table [columns] of a model file; none for a shipped model. Raises ModelError."""
    return columns_of(written_columns(name))


def written_columns(name: str | None) -> Mapping[str, str]:
    """The same as it is written. Raises ModelError."""
    return read(name).columns if name is not None and name.endswith(".toml") else {}


def chosen_effect(name: str) -> Effect:
    """An effect of the catalogue by name, or one's own from a file. Raises ModelError."""
    return load_effect(Path(name)) if name.endswith(SUFFIXES) else find(name)
