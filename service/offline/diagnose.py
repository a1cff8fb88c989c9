"""Diagnose the model of a machine from recordings, by a function for command line and notebooks.

A vehicle whose actuators have a model of their own is diagnosed in two parts, from command to motion and from that
motion on (diagnosis.parts). Besides the missing effects, the result suggests the next experiment and, if no effect was
named, reports effects that set in during the run.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from upright.diagnosis.diagnose import Diagnosis, Progress, Verdict, diagnose
from upright.diagnosis.parts import diagnose_parts
from upright.diagnosis.prepare.actuator_samples import looked_at
from upright.diagnosis.report import Provenance, write_report
from upright.estimators.budget import Budget, OutOfTime
from upright.estimators.contract import EstimationError
from upright.models.effect import Effect
from upright.models.model import Model
from upright.service.offline.inputs.machine import as_measured, is_of, loops_of, support_of
from upright.service.offline.inputs.question import asked_of
from upright.service.offline.inputs.replay import live_diagnosis
from upright.service.offline.models import identified_model
from upright.service.offline.next_experiment import suggest_for
from upright.telemetry.errors import RecordingError
from upright.telemetry.options import option
from upright.telemetry.recording import Recording
from upright.vehicles import registry
from upright.vehicles.experiment.load import refuse_loads, with_load
from upright.vehicles.file import VehicleFile

BUDGET, ROWS = 60.0, 12_000
"""Default time limit, s, of a diagnosis of so many samples; proportionally more for more samples."""
DIAGNOSIS = 0.85
"""Share of the time for the diagnosis itself. The rest is for the next experiment and for onsets during the run."""


@dataclass(frozen=True, slots=True)
class Part:
    """The diagnosis `found` of one bare `model` with its `recordings`."""

    found: Diagnosis
    model: Model
    recordings: Sequence[Recording]


@dataclass(frozen=True, slots=True)
class Diagnosed:
    """The diagnosis `found` of `model` within `seconds`, with its joint on supports at `support` rad; `parts` are those
    to be reported, the one with the likeliest effect first."""

    found: Diagnosis
    model: Model
    support: float | None
    seconds: float
    parts: tuple[Part, ...]

    def pages(
        self, provenance: Provenance | None = None, progress: Callable[[str], None] = lambda text: None
    ) -> list[str]:
        """The report of each part as HTML."""
        return [
            write_report(
                part.found,
                part.model,
                part.recordings,
                support=self.support,
                provenance=provenance,
                seconds=self.seconds,
                progress=progress,
            )
            for part in self.parts
        ]


def report_paths(report: Path, count: int) -> list[Path]:
    """FILE.html, and FILE-2.html for a second part."""
    return [report, *(report.with_stem(f"{report.stem}-{number}") for number in range(2, count + 1))]


def diagnosed(
    recordings: Sequence[Recording],
    vehicle: VehicleFile | None,
    *,
    model: str | Path | Model | None = None,
    candidates: Sequence[str | Effect] | None = None,
    most: int = 3,
    seconds: float | None = None,
    reserved: float = 0.0,
    begin: float = 0.0,
    progress: Progress | None = None,
) -> Diagnosed:
    """Find what the model of `vehicle`, or a `model` of one's own, lacks to explain `recordings`. Without a `vehicle`
    they are of a machine that has only a model.

    The last of several recordings is held out for validation, or each third of a single one in turn. `candidates` are
    the effects to look for, the whole catalogue by default; at most `most` of them are added. `seconds` is the time
    limit, `math.inf` for none, of which a share is `reserved` for later work; by default BUDGET, proportionally more
    for over ROWS samples. `begin` s: the recordings were cut off before it, for messages. `progress` gets the current
    step and the share that is done.
    Raises ModelError and EstimationError for an invalid model or name, RecordingError for a recording with a load among
    several; unusable data give a verdict.
    """
    report = progress or (lambda text, share: None)
    if seconds is not None and not seconds > 0.0:
        raise EstimationError("budget", f"{seconds:g} s is no time", remedy="give more than 0 s; inf means no limit.")
    nominal = as_measured(to_be_completed(model, vehicle), vehicle, recordings)
    support = support_of(nominal, vehicle)
    own = vehicle if is_of(nominal, vehicle) else None
    if len(recordings) == 1:
        nominal = with_load(nominal, recordings[0])
    else:
        refuse_loads(recordings)
    actuators = actuators_of(vehicle, model)
    seconds = default_budget(recordings) if seconds is None else seconds
    whole = Budget.of(None if math.isinf(seconds) else seconds * (1.0 - reserved))
    report("checking how the tables are to be read", 0.0)
    if asked := asked_of(nominal, recordings, support):
        found = Diagnosis(Verdict.INSUFFICIENT_DATA, str(asked))
        return Diagnosed(found, nominal, support, seconds, (Part(found, nominal, recordings),))
    way = partial(diagnose_parts, nominal, actuators) if actuators else partial(diagnose, nominal)
    found = np.errstate(all="ignore")(way)(  # a model that diverges in a trial is a trial that failed
        recordings,
        support=support,
        candidates=candidates,
        most=most,
        budget=None if math.isinf(seconds) else DIAGNOSIS * whole.left,
        loops=loops_of(nominal, vehicle, recordings),
        progress=progress,
    )
    parts = _parts(found, nominal, recordings, support)
    # Experiments are predicted for the vehicle, not for its actuators.
    if parts[0].model is nominal and own is not None:
        report("choosing the next experiment", 1.0)
        try:
            suggested = suggest_for(own, parts[0].found, nominal, recordings, budget=whole)
            found = replace(found, suggested_experiment=suggested)
        except OutOfTime:
            found = replace(found, untried=(*found.untried, "the choice of the next experiment"))
    if found.verdict is Verdict.UNKNOWN and not found.findings and own is not None and model is None:
        report("searching for effects that set in during the run", 1.0)
        try:
            found = replace(found, reason=found.reason + _sets_in(recordings, own, begin, whole))
        except OutOfTime:
            found = replace(found, untried=(*found.untried, "the search for effects that set in during the run"))
    next_one, untried = found.suggested_experiment, found.untried
    shown = (replace(each.found, suggested_experiment=next_one, untried=untried) for each in parts)
    completed = tuple(replace(part, found=each) for part, each in zip(parts, shown, strict=True))
    return Diagnosed(found, nominal, support, seconds, completed)


def to_be_completed(given: str | Path | Model | None, vehicle: VehicleFile | None) -> Model:
    """The `given` model, or the vehicle's own without the effects that identification assumes: the diagnosis has to
    find these."""
    model = identified_model(given, vehicle)
    for attached in model.effects if given is None else ():
        model = model.remove(attached.name)
    return model


def actuators_of(vehicle: VehicleFile | None, model: str | Path | Model | None) -> tuple[Model, ...]:
    """The models of the vehicle's actuators, which are diagnosed with its own model."""
    return tuple(registry.models_of(vehicle).actuators) if vehicle is not None and model is None else ()


def default_budget(recordings: Sequence[Recording]) -> float:
    """The default time limit, s."""
    return BUDGET * max(1.0, sum(map(len, recordings)) / ROWS)


def _parts(found: Diagnosis, nominal: Model, recordings: Sequence[Recording], support: float | None) -> list[Part]:
    """The vehicle alone, or, if the actuators lack something, the parts that lack something, with the likeliest effect
    first."""
    vehicle = Part(found.parts[0] if found.parts else found, nominal, recordings)
    if not found.parts or not found.parts[1].findings or not found.findings:
        return [vehicle]
    bare = found.parts[1].steps[0].model
    actuators = Part(found.parts[1], bare, looked_at(bare, recordings, support))
    lacking = [vehicle, actuators] if vehicle.found.findings else [actuators]
    return sorted(lacking, key=lambda each: found.findings[0] not in each.found.findings)


def _sets_in(recordings: Sequence[Recording], vehicle: VehicleFile, begin: float, budget: Budget) -> str:
    """Sentences about effects that set in during a recording, since a model with a constant effect cannot explain them.

    Raises OutOfTime.
    """
    text = ""
    for recording in recordings:
        try:
            shown = live_diagnosis(recording, vehicle, budget) or {"findings": []}
        except RecordingError:
            continue
        for each in shown["findings"][:1]:
            if each["since"]:
                since = begin + each["since"]
                after = math.ceil(since) + 1
                text += (
                    f" {each['effect']} sets in at {since:.0f} s in {Path(recording.source).name}: diagnose the part"
                    f" after that, {option(f'upright diagnose {recording.source} --from {after}', f'begin={after}')}."
                )
    return text
