"""Model files as they are changed step by step: started, an effect added or removed, written.

Between reading and writing, the paths of the user's own effects (`effect_files`) and of the model of the actuators
(`actuators_file`) are absolute, since the folder of the next file is not known yet.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

from upright.models.effect import AttachedEffect, Effect
from upright.models.file.allowed_code import sha256
from upright.models.file.document import ModelFile
from upright.models.file.history import values_of
from upright.models.file.model_file import read, write
from upright.models.model import Model
from upright.models.parts import ModelError
from upright.service.offline.models import SUFFIXES, chosen_effect, identified_model
from upright.vehicles.experiment.load import without_load
from upright.vehicles.sections import VehicleFile

if TYPE_CHECKING:
    from upright.diagnosis.diagnose import Diagnosis
    from upright.service.offline.identify import Identified


def started(given: str | Path | Model | None, vehicle: VehicleFile | None = None) -> ModelFile:
    """A model file with its history; or one that is not written yet, of a model, a shipped one by name, or by default
    the vehicle's, with the CAD values of the vehicle.

    Raises ModelError and EstimationError.
    """
    if isinstance(given, Model) or not str(given).endswith(".toml"):
        return ModelFile(identified_model(given, vehicle))
    found = read(str(given))
    folder = Path(str(given)).resolve().parent
    return replace(
        found,
        effect_files={name: str(folder / path) for name, path in found.effect_files.items()},
        actuators_file=str(folder / found.actuators_file) if found.actuators_file else "",
    )


def with_effect(file: ModelFile, effect: str | Path | Effect, at: str = "") -> ModelFile:
    """`file` with an effect of the catalogue or of one's own, which changes nothing yet, and an entry in its history.

    Raises ModelError.
    """
    model = file.model.add(chosen_effect(effect), at)
    name = model.effects[-1].name
    entry: dict[str, Any] = {"action": "add", "effect": name, "date": now()}
    files = dict(file.effect_files)
    if not isinstance(effect, Effect) and str(effect).endswith(SUFFIXES):
        entry["effect_sha256"] = sha256(Path(effect).read_bytes())
        files[name] = str(Path(effect).resolve())
    return replace(file, model=model, history=(*file.history, entry), effect_files=files)


def without_effect(file: ModelFile, name: str) -> ModelFile:
    """`file` without the effect `name` of its model, and an entry in its history. Raises ModelError."""
    files = {own: path for own, path in file.effect_files.items() if own != name}
    entry = {"action": "remove", "effect": name, "date": now()}
    return replace(file, model=file.model.remove(name), history=(*file.history, entry), effect_files=files)


def identified(file: ModelFile, answer: Identified, hashes: Mapping[str, str]) -> ModelFile | None:
    """`file` with the values and standard deviations of the recommended method, and an entry in its history that knows
    those before; None if no method is recommended. `hashes` as in `revised`."""
    fitted = answer.fitted
    if fitted is None:
        return None
    entry = {
        "action": "identify",
        "method": answer.document["best"],
        "date": now(),
        "recording": list(hashes),
        "sha256": list(hashes.values()),
        **values_of(file.model, fitted),
    }
    return replace(file, model=fitted, history=(*file.history, entry))


def revised(
    file: ModelFile, found: Diagnosis, hashes: Mapping[str, str], own: Mapping[str, Path], date: object
) -> ModelFile:
    """`file` with the model that a diagnosis `found`, and an entry in its history for each effect that it added. If the
    actuators lack an effect, their model with it (`of_actuators`) belongs to the model.

    `hashes`: SHA-256 of the files of the recordings, by name. `own`: the files of effects of the user's own,
    by the effect's name.
    """
    assert found.revised is not None
    model = without_load(found.revised)
    if (actuators := of_actuators(found)) is not None and actuators.revised is not None:
        model, file = replace(model, actuators_model=actuators.revised), replace(file, actuators_file="")
    in_it = {each.name: each for each in model.effects}
    entries = tuple(
        {
            "action": "add",
            "effect": finding.effect,
            "date": date,
            "recording": list(hashes),
            "sha256": list(hashes.values()),
            "tied_with": list(finding.tied_with),
            "probability": float(f"{finding.probability:.4g}"),
            **_written(in_it[finding.effect]),
        }
        for finding in found.findings
        if finding.effect in in_it
    )
    files = {each.name: str(own[each.effect.name].resolve()) for each in model.effects if each.effect.name in own}
    kept = {name: path for name, path in file.effect_files.items() if name in in_it}
    return replace(file, model=model, history=(*file.history, *entries), effect_files={**kept, **files})


def _written(effect: AttachedEffect) -> dict[str, Any]:
    """`values_after` of its parameters whose deviation a fit has written."""
    known = {each.name: {"value": each.value, "std": each.std} for each in effect.parameters if each.std}
    return {"values_after": known} if known else {}


def of_actuators(found: Diagnosis) -> Diagnosis | None:
    """The part of a diagnosis that is of the actuators, if they lack an effect: with the deviations of its parameters
    in the model, since no identification follows that would determine them."""
    for part in found.parts[1:]:
        if part.findings and part.revised is not None:
            known = {
                name: each.std
                for finding in part.findings
                for name, each in finding.parameters.items()
                if each.std is not None and name in part.revised.values
            }
            return replace(part, revised=part.revised.change(deviations=known))
    return None


def save(file: ModelFile, target: Path) -> None:
    """Write `file` to `target` atomically. A model of the actuators that has no file yet is written beside it first.

    Raises ModelError as models.file.model_file.write does.
    """
    if target.suffix != ".toml":
        raise ModelError(str(target), "is not a name of a model file", remedy="use the suffix .toml.")
    actuators = file.model.actuators_model
    if actuators is not None and not file.actuators_file:
        file = replace(file, actuators_file=str(actuators_beside(target)))
        save(ModelFile(actuators), Path(file.actuators_file))
    folder = target.resolve().parent
    written = replace(
        file,
        effect_files={name: os.path.relpath(path, folder) for name, path in file.effect_files.items()},
        actuators_file=os.path.relpath(file.actuators_file, folder) if file.actuators_file else "",
    )
    write(written, target)


def actuators_beside(target: Path) -> Path:
    """The file of the model of the actuators that belongs to the one in `target`."""
    return target.with_name(f"{target.stem}-actuators.toml").absolute()


def now() -> datetime:
    """To the second, as a history states it."""
    return datetime.now(UTC).replace(microsecond=0)
