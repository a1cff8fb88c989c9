"""What a machine lacks, from its recordings, as a plain function: command line and notebooks call it alike.

A vehicle whose actuators have a model of their own is diagnosed in two parts, from command to motion and from there on
(diagnosis.parts). Beside the effects that are missing it is said which experiment would tell more, and, where nothing
has a name, what sets in during the run.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

from diagnosis.diagnose import Diagnosis, Progress, Verdict, diagnose
from diagnosis.parts import diagnose_parts
from diagnosis.prepare.actuator_samples import looked_at
from estimators.budget import Budget, OutOfTime
from models.effect import Effect
from models.model import Model
from service.offline.machine import is_of, support_of
from service.offline.models import identified_model
from service.offline.next_experiment import suggest_for
from service.offline.replay import live_diagnosis
from telemetry.errors import RecordingError
from telemetry.recording import Recording
from vehicles import registry
from vehicles.file import VehicleFile

BUDGET, ROWS = 60.0, 12_000
"""s that a diagnosis of so many rows may take by default, of more rows in proportion."""
DIAGNOSIS = 0.85
"""Share of the time for the diagnosis itself: the rest is for the next experiment, and what sets in during the run."""


@dataclass(frozen=True, slots=True)
class Part:
    """What one model lacks: `found`, of the bare `model` and its `recordings`."""

    found: Diagnosis
    model: Model
    recordings: Sequence[Recording]


@dataclass(frozen=True, slots=True)
class Diagnosed:
    """`found` of `model` within `seconds`, its joint on supports at `support` rad; `parts`: what a report is on, the
    one with the likeliest effect first."""

    found: Diagnosis
    model: Model
    support: float | None
    seconds: float
    parts: tuple[Part, ...]


def diagnosed(
    recordings: Sequence[Recording],
    vehicle: VehicleFile,
    *,
    model: str | None = None,
    candidates: Sequence[str | Effect] | None = None,
    most: int = 3,
    seconds: float | None = None,
    reserved: float = 0.0,
    begin: float = 0.0,
    progress: Progress | None = None,
) -> Diagnosed:
    """What `vehicle`, or the machine of a `model` file, lacks to explain `recordings`.

    Of several recordings the last is held out to check on; of a single one each third in turn. `candidates`: effects to
    look for, the whole catalogue by default; `most` of them are added. `seconds` that it may take, `math.inf` for as
    long as it takes, of which a share is `reserved` for what comes after; by default BUDGET, in proportion more for
    over ROWS rows. `begin` s: at which a recording was cut off, for the words. `progress` is told what is being done
    and the share of it that is over.
    Raises ModelError and EstimationError for a model or names that cannot be; data that cannot be used give a verdict.
    """
    tell = progress or (lambda text, share: None)
    nominal = to_be_completed(model, vehicle)
    support, of_vehicle = support_of(nominal, vehicle), is_of(nominal, vehicle)
    actuators = registry.models_of(vehicle).actuators if model is None else ()
    seconds = default_budget(recordings) if seconds is None else seconds
    whole = Budget.of(None if math.isinf(seconds) else seconds * (1.0 - reserved))
    way = partial(diagnose_parts, nominal, actuators) if actuators else partial(diagnose, nominal)
    found = way(
        recordings,
        support=support,
        candidates=candidates,
        most=most,
        budget=None if math.isinf(seconds) else DIAGNOSIS * whole.left,
        loops=[registry.recorded_loop(vehicle, each) for each in recordings] if of_vehicle else (),
        progress=progress,
    )
    parts = _parts(found, nominal, recordings, support)
    # Experiments are predicted for the vehicle, which its actuators only move.
    if parts[0].model is nominal and of_vehicle:
        tell("choosing the next experiment", 1.0)
        try:
            suggested = suggest_for(vehicle, parts[0].found, nominal, recordings, budget=whole)
            found = replace(found, suggested_experiment=suggested)
        except OutOfTime:
            found = replace(found, untried=(*found.untried, "the choice of the next experiment"))
    if found.verdict is Verdict.UNKNOWN and not found.findings and model is None:
        tell("looking for what sets in during the run", 1.0)
        try:
            found = replace(found, reason=found.reason + _sets_in(recordings, vehicle, begin, whole))
        except OutOfTime:
            found = replace(found, untried=(*found.untried, "what sets in during the run"))
    next_one, untried = found.suggested_experiment, found.untried
    shown = (replace(each.found, suggested_experiment=next_one, untried=untried) for each in parts)
    told = tuple(replace(part, found=each) for part, each in zip(parts, shown, strict=True))
    return Diagnosed(found, nominal, support, seconds, told)


def to_be_completed(name: str | None, vehicle: VehicleFile) -> Model:
    """The model `name`, or the vehicle's own without what identification assumes beside its equations: that is to be
    found."""
    model = identified_model(name, vehicle)
    for attached in model.effects if name is None else ():
        model = model.remove(attached.name)
    return model


def default_budget(recordings: Sequence[Recording]) -> float:
    """s, where nothing else is asked for."""
    return BUDGET * max(1.0, sum(map(len, recordings)) / ROWS)


def _parts(found: Diagnosis, nominal: Model, recordings: Sequence[Recording], support: float | None) -> list[Part]:
    """The vehicle, or else the part with the likeliest effect first, and the other one where it lacks something,
    too."""
    vehicle = Part(found.parts[0] if found.parts else found, nominal, recordings)
    if not found.parts or not found.parts[1].findings or not found.findings:
        return [vehicle]
    bare = found.parts[1].steps[0].model
    actuators = Part(found.parts[1], bare, looked_at(bare, recordings, support))
    told = [vehicle, actuators] if vehicle.found.findings else [actuators]
    return sorted(told, key=lambda each: found.findings[0] not in each.found.findings)


def _sets_in(recordings: Sequence[Recording], vehicle: VehicleFile, begin: float, budget: Budget) -> str:
    """What does not act in all of a recording: no effect of a model does that, so that it has no name there.

    Raises OutOfTime.
    """
    told = ""
    for recording in recordings:
        try:
            shown = live_diagnosis(recording, vehicle, budget) or {"findings": []}
        except RecordingError:
            continue
        for each in shown["findings"][:1]:
            if each["since"]:
                since = begin + each["since"]
                told += (
                    f" {each['effect']} shows in {Path(recording.source).name} since {since:.0f} s: look at the rest of"
                    f" it alone, upright diagnose {recording.source} --from {math.ceil(since) + 1}."
                )
    return told
