"""The output of `upright diagnose --auto`: the model with all effects found, and a record of the steps."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

from diagnosis.diagnose import Diagnosis
from models.file.document import ModelFile
from models.file.model_file import write
from models.model import Model
from vehicles.load import without_load


def write_trail(
    target: Path,
    found: Diagnosis,
    nominal: Model,
    hashes: Mapping[str, str],
    own: Mapping[str, Path],
    columns: Mapping[str, str] | None = None,
) -> None:
    """Write the revised model to `target`, with its history, and all steps to `target` with the suffix .trail.json.

    Effects missing in the vehicle's actuators are written to a separate model beside it, NAME-actuators.toml.

    `hashes`: SHA-256 of the recordings, by name. `own`: the files of effects of the user's own, by the effect's name.
    `columns`: the table [columns] of the model file. Raises OSError and ModelError if the files cannot be written.
    """
    assert found.revised is not None
    for part in found.parts[1:]:
        if part.findings and part.steps:
            write_trail(target.with_name(f"{target.stem}-actuators.toml"), part, part.steps[0].model, hashes, own)
    in_it = {each.name for each in found.revised.effects}
    date = datetime.now(UTC).strftime("%Y-%m-%d %H:%M:%S UTC")
    history = tuple(
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
    model = replace(without_load(found.revised), name=target.stem)
    there = {each.name: own[each.effect.name] for each in model.effects if each.effect.name in own}
    files = {name: os.path.relpath(path, target.resolve().parent) for name, path in there.items()}
    write(ModelFile(model=model, history=history, effect_files=files, columns=columns or {}), target)
    document = {"date": date, "model": nominal.name, "recordings": dict(hashes), **found.to_json()}
    target.with_suffix(".trail.json").write_text(json.dumps(document, indent=2) + "\n", encoding="utf-8")
