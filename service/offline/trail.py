"""The output of `upright diagnose --auto`: the model with all effects found, and a record of the steps."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

from upright.diagnosis.diagnose import Diagnosis
from upright.models.file.document import ModelFile
from upright.models.model import Model
from upright.service.offline.model_files import revised, save
from upright.service.whole_file import write_whole


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
    date = datetime.now(UTC).strftime("%Y-%m-%d %H:%M:%S UTC")
    file = revised(ModelFile(nominal, columns=columns or {}), found, hashes, own, date)
    save(replace(file, model=replace(file.model, name=target.stem)), target)
    document = {"date": date, "model": nominal.name, "recordings": dict(hashes), **found.to_json()}
    write_whole(target.with_suffix(".trail.json"), json.dumps(document, indent=2) + "\n")
