"""`upright identify --report`: its document as a page, with predictions by the estimates and by the CAD values."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from diagnosis.prediction.compare import Comparison, compare
from diagnosis.report import write_identification
from models.model import Model
from service.offline.machine import is_of, name_of, support_of
from service.offline.provenance import provenance
from telemetry.errors import UprightError
from telemetry.recording import Recording
from vehicles.file import VehicleFile
from vehicles.registry import recorded_loop


def save_report(
    target: Path,
    document: Mapping[str, Any],
    vehicle: VehicleFile,
    model: Model,
    paths: Sequence[Path],
    recordings: Sequence[Recording],
    truth: Mapping[str, float],
    step: Callable[[str], None],
) -> None:
    """Write the page of `document` to `target`; `recordings` with their `paths` were used, `model` was fitted."""
    step("comparing the estimates with the CAD values")
    comparisons, why = _compared(document, vehicle, model, recordings, step)
    text = write_identification(
        document,
        model.name,
        truth=truth,
        comparisons=comparisons,
        why=why,
        provenance=provenance(name_of(model, vehicle), list(paths), recordings),
        progress=step,
    )
    target.write_text(text, encoding="utf-8")


def _compared(
    document: Mapping[str, Any],
    vehicle: VehicleFile,
    model: Model,
    recordings: Sequence[Recording],
    step: Callable[[str], None],
) -> tuple[list[Comparison], str]:
    """The model with its CAD values and with the recommended estimates, compared with all recordings; or the reason why
    that is not possible."""
    best = document["best"]
    if not best:
        return [], "No method can be recommended, so no model is compared with the recordings."
    known = {parameter.name for parameter in model.parameters}
    found = document["methods"][best]["parameters"]
    values = {name: each["value"] for name, each in found.items() if name in known and each["value"] is not None}
    models = {"CAD": model, best: model.change(values)}
    try:
        loops = [recorded_loop(vehicle, each) for each in recordings] if is_of(model, vehicle) else []
        return compare(models, recordings, support=support_of(model, vehicle), loops=loops, progress=step), ""
    except UprightError as error:
        return [], f"The models could not be simulated with the recordings: {error}"
