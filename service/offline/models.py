"""Models and effects as a person gives them: by name, by file, or as the object itself."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from upright.estimators.contract import EstimationError
from upright.estimators.identify.run import with_values
from upright.models.effect import Effect
from upright.models.effects.catalogue import CATALOGUE, find
from upright.models.file.effect_rules import validate
from upright.models.file.model_file import load_model, read
from upright.models.file.own_effects import load_effect
from upright.models.model import Model
from upright.models.parts import ModelError
from upright.service.offline.inputs.machine import is_of
from upright.telemetry.errors import RecordingError
from upright.telemetry.tables.mapping import Source, columns_of
from upright.vehicles.registry import nominal_model
from upright.vehicles.sections import VehicleFile

CAD = "CAD"
"""The name of the vehicle's own model with the values of the vehicle file, where models are compared."""
SUFFIXES = (".toml", ".py")
"""Suffixes of files with an effect of one's own."""


def identified_model(model: str | Path | Model | None, vehicle: VehicleFile | None) -> Model:
    """A model or a model file unchanged, or a shipped model (by default the vehicle's) with the CAD values of the
    vehicle file, if there is one.

    Raises ModelError, EstimationError.
    """
    if isinstance(model, Model):
        return model
    if model is not None and (vehicle is None or str(model).endswith(".toml")):
        return load_model(model)
    if vehicle is None:
        remedy = "give a model, or the vehicle that made the recordings."
        raise EstimationError("model", "none is given, and the recordings name no vehicle", remedy=remedy)
    found = nominal_model(vehicle.vehicle.kind) if model is None else load_model(model)
    return with_values(found, vehicle.parameters.values, vehicle.parameters.deviations)


def columns(model: str | Path | Model | None) -> dict[str, Source]:
    """The table [columns] of a model file; none for another model. Raises ModelError."""
    return columns_of(written_columns(model))


def written_columns(model: str | Path | Model | None) -> Mapping[str, str]:
    """The same as it is written. Raises ModelError."""
    return read(str(model)).columns if str(model).endswith(".toml") and not isinstance(model, Model) else {}


def chosen_effect(effect: str | Path | Effect) -> Effect:
    """An effect of the catalogue by name, or one's own, from a file or as it is. Raises ModelError."""
    if not isinstance(effect, Effect):
        return load_effect(Path(effect)) if str(effect).endswith(SUFFIXES) else find(str(effect))
    if effect.name in CATALOGUE and effect != CATALOGUE[effect.name]:
        remedy = "choose another name, or give the name of that one."
        raise ModelError(f"effect {effect.name}", "the catalogue has another effect of this name", remedy=remedy)
    if effect.name not in CATALOGUE:
        validate(effect)
    return effect


@dataclass(frozen=True, slots=True)
class Candidates:
    """The `effects` to look for, None for the whole catalogue, and the `files` of one's own, by the effect's name."""

    effects: tuple[Effect, ...] | None
    files: Mapping[str, Path]

    @classmethod
    def of(
        cls, alone: Sequence[str | Path | Effect] | None = None, also: Sequence[str | Path | Effect] = ()
    ) -> Candidates:
        """The effects `alone` instead of the catalogue, and `also` these. Raises ModelError."""
        wanted = [*(alone or ()), *also]
        chosen = [chosen_effect(each) for each in wanted]
        files = {
            effect.name: Path(each)
            for each, effect in zip(wanted, chosen, strict=True)
            if not isinstance(each, Effect) and str(each).endswith(SUFFIXES)
        }
        if not chosen:
            return cls(None, files)
        return cls((*(() if alone else CATALOGUE.values()), *chosen), files)


def compared_models(
    models: Sequence[str | Path], vehicle: VehicleFile | None, note: Callable[[str], None] = lambda text: None
) -> dict[str, Model]:
    """Models by name: from model files, of the shipped ones, or from JSON with estimates; after the vehicle's own with
    its CAD values if one of them is of the vehicle. `note` gets a sentence about estimates that are left out.

    Raises ModelError and RecordingError for what is no model, and EstimationError if none is given and the vehicle has
    no model of its own.
    """
    found: dict[str, Model] = {}
    try:
        found[CAD] = identified_model(None, vehicle)
    except EstimationError:
        if not models:
            raise
    for given in map(str, models):
        read = estimated(Path(given), found.get(CAD), note) if given.endswith(".json") else {}
        if not given.endswith(".json"):
            read[Path(given).stem if given.endswith(".toml") else given] = identified_model(given, vehicle)
        for name, each in read.items():
            found[name if name not in found else f"{name} ({Path(given).name})"] = each
    others = {name: each for name, each in found.items() if name != CAD}
    return others if others and not any(is_of(each, vehicle) for each in others.values()) else found


def estimated(path: Path, base: Model | None, note: Callable[[str], None] = lambda text: None) -> dict[str, Model]:
    """Models by name from a JSON file of estimates: `base` with the estimates of each method, or, from the output of
    `upright model add --json`, the model before the addition, fitted to the same recordings.

    Raises RecordingError if the file has no estimates, or if no model is known that they belong to; ModelError if the
    model file to which an effect was added does not exist any more, or does not have the effect.
    """
    models = {}
    try:
        document = json.loads(path.read_text())
        if "repair" in document:
            return {f"without {document['effect']}": _without_effect(document)}
        if base is None:
            remedy = "Give the model itself: --model FILE.toml."
            raise RecordingError(str(path), "", "has parameter values, but their model is not known", remedy=remedy)
        names = {parameter.name for parameter in base.parameters}
        methods: dict[str, Any] = document.get("methods") or document.get("estimates") or document
        for name, method in methods.items():
            values = {key: entry["value"] for key, entry in method["parameters"].items() if entry["value"] is not None}
            strange = [key for key in values if "." in key and key not in names]
            if strange:
                note(f"{path.name}, {name}: {base.name} has no {', '.join(strange)}, left out")
            elif not names.isdisjoint(values):
                models[name] = base.change({key: value for key, value in values.items() if key in names})
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise RecordingError(
            str(path),
            "",
            f"has no estimates ({error})",
            remedy="Write one with `upright identify ... --json > FILE`.",
        ) from error
    return models


def _without_effect(document: dict[str, Any]) -> Model:
    """The model of the file to which `upright model add` added an effect, without it and with the values fitted so."""
    values = {name: each["value"] for name, each in document["repair"]["before"]["parameters"].items()}
    return load_model(document["file"]).remove(document["effect"]).change(values)


def estimates_beside(recording: Path) -> Path:
    """The file of the live estimates of `recording`."""
    return recording.with_suffix(".estimates.json")
