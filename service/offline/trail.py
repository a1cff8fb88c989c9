"""The output of `upright diagnose --auto`: the model with all effects found, and a record of the steps."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

from upright.diagnosis.diagnose import Diagnosis
from upright.models.file.document import ModelFile
from upright.models.file.model_file import load_model
from upright.service.offline.model_files import actuators_beside, of_actuators, revised, save
from upright.service.whole_file import write_whole


def write_trail(
    target: Path, found: Diagnosis, before: ModelFile, hashes: Mapping[str, str], own: Mapping[str, Path]
) -> None:
    """Write the revised model to `target`, with its history, and all steps to `target` with the suffix .trail.json.

    If the vehicle's actuators lack an effect, their model is written beside it, NAME-actuators.toml, and belongs to it.

    `before`: the model that was diagnosed. `hashes`: SHA-256 of the recordings, by name. `own`: the files of effects of
    the user's own, by the effect's name. Raises OSError and ModelError if the files cannot be written.
    """
    assert found.revised is not None
    date = datetime.now(UTC).strftime("%Y-%m-%d %H:%M:%S UTC")
    file = revised(before, found, hashes, own, date)
    if (actuators := of_actuators(found)) is not None:
        beside = actuators_beside(target)
        write_trail(beside, actuators, ModelFile(actuators.steps[0].model), hashes, own)
        file = replace(file, model=replace(file.model, actuators_model=load_model(beside)), actuators_file=str(beside))
    save(replace(file, model=replace(file.model, name=target.stem)), target)
    document = {"date": date, "model": before.model.name, "recordings": dict(hashes), **found.to_json()}
    write_whole(target.with_suffix(".trail.json"), json.dumps(document, indent=2) + "\n")
