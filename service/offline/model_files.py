"""Model files as they are changed step by step: started, an effect added or removed, written.

Between reading and writing, the paths of the user's own effects (`effect_files`) are absolute, since the folder of the
next file is not known yet.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

from upright.models.effect import Effect
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
    return replace(found, effect_files={name: str(folder / path) for name, path in found.effect_files.items()})


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
    """`file` with the model that a diagnosis `found`, and an entry in its history for each effect that it added.

    `hashes`: SHA-256 of the files of the recordings, by name. `own`: the files of effects of the user's own,
    by the effect's name.
    """
    assert found.revised is not None
    model = without_load(found.revised)
    in_it = {each.name for each in model.effects}
    entries = tuple(
        {
            "action": "add",
            "effect": finding.effect,
            "date": date,
            "recording": list(hashes),
            "sha256": list(hashes.values()),
            "tied_with": list(finding.tied_with),
            "probability": float(f"{finding.probability:.4g}"),
        }
        for finding in found.findings
        if finding.effect in in_it
    )
    files = {each.name: str(own[each.effect.name].resolve()) for each in model.effects if each.effect.name in own}
    kept = {name: path for name, path in file.effect_files.items() if name in in_it}
    return ModelFile(model, (*file.history, *entries), {**kept, **files})


def save(file: ModelFile, target: Path) -> None:
    """Write `file` to `target` atomically. Raises ModelError as models.file.model_file.write does."""
    if target.suffix != ".toml":
        raise ModelError(str(target), "is not a name of a model file", remedy="use the suffix .toml.")
    folder = target.resolve().parent
    write(replace(file, effect_files={n: os.path.relpath(p, folder) for n, p in file.effect_files.items()}), target)


def now() -> datetime:
    """To the second, as a history states it."""
    return datetime.now(UTC).replace(microsecond=0)
