"""`upright diagnose`: find the physical effect that a model lacks."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import typer

from upright.service.cli.arguments import (
    AlsoOption,
    AssumeOption,
    DbcOption,
    DiagnosedModelOption,
    EffectOption,
    FromOption,
    MapOption,
    RecordingsArgument,
    ToOption,
    VehicleOption,
)
from upright.service.output import page, print_json
from upright.service.whole_file import write_whole

DRAWING = 0.1
"""Share of the time budget that is reserved for drawing a report."""


def diagnose(
    recordings: RecordingsArgument,
    vehicle: VehicleOption = "monocab",
    model: DiagnosedModelOption = None,
    effect: EffectOption = None,
    own: AlsoOption = None,
    begin: FromOption = 0.0,
    end: ToOption = math.inf,
    map_: MapOption = None,
    assume: AssumeOption = None,
    dbc: DbcOption = None,
    auto: Annotated[
        Path | None,
        typer.Option(
            "--auto",
            help="Add effects until the model is adequate or no effect explains the remaining error; write the model to"
            " this file, and a record of all steps beside it.",
        ),
    ] = None,
    budget: Annotated[
        float | None,
        typer.Option(
            "--budget",
            help="Time limit in seconds, e.g. --budget 300; what could not be tried is reported. --budget inf: no"
            " limit.",
            show_default="60, and proportionally more for over 12,000 samples",
        ),
    ] = None,
    report: Annotated[
        Path | None,
        typer.Option("--report", help="Write a self-contained page to read, mail and print: FILE.html."),
    ] = None,
    json: Annotated[bool, typer.Option("--json", help="One JSON document on stdout.")] = False,
) -> Any:  # the diagnosis; Typer would import its type for every command
    """Find the physical effect that a model lacks, or report that the recordings are not sufficient.

    The last of several recordings is held out for validation, or each third of a single one in turn. A vehicle whose
    actuators have a model of their own is diagnosed in two parts: from the command to the actuators' motion, and from
    that motion on. If both parts lack something, a second report is written beside the first. Ctrl-C ends it.
    """
    from upright.diagnosis.diagnose import Verdict
    from upright.service.cli.inputs import load_recordings, share_done
    from upright.service.offline.diagnose import actuators_of, default_budget, diagnosed, report_paths, to_be_completed
    from upright.service.offline.inputs.machine import name_of
    from upright.service.offline.models import Candidates, columns
    from upright.service.offline.provenance import provenance
    from upright.telemetry.tables.mapping import said_of
    from upright.vehicles.file import load

    for target in (auto, report):
        if target is not None and not target.absolute().parent.is_dir():
            raise typer.BadParameter(f"there is no folder {target.parent} to write {target.name} to")
    if budget is not None and not budget > 0.0:
        raise typer.BadParameter("has to be more than 0 s; inf means no limit.", param_hint="--budget")
    file = load(vehicle)
    candidates = Candidates.of(effect, own or ())
    user = said_of(map_ or [], assume or [], columns(model))
    needed = [to_be_completed(model, file), *actuators_of(file, model)]
    loaded = load_recordings(recordings, file, needed, user=user, begin=begin, end=end, database=dbc)
    read = provenance("", recordings, loaded)  # now, since minutes later a file may have changed
    seconds = default_budget(loaded) if budget is None else budget
    with share_done(seconds) as progress:
        answer = diagnosed(
            loaded,
            file,
            model=model,
            candidates=candidates.effects,
            most=6 if auto else 3,
            seconds=seconds,
            reserved=0.0 if report is None else DRAWING,
            begin=begin,
            progress=progress,
        )
        found, origin = answer.found, replace(read, vehicle=name_of(answer.model, file))
        pages = []
        if report is not None:
            texts = answer.pages(origin, progress=lambda text: progress(text, 1.0))
            pages = report_paths(report, len(texts))
            for path, text in zip(pages, texts, strict=True):
                write_whole(path, text)
    if auto is not None and found.revised is not None:
        from upright.service.offline.model_files import started
        from upright.service.offline.trail import write_trail

        before = replace(started(model, file), model=answer.model)
        write_trail(auto, found, before, origin.hashes, candidates.files)
    if json:
        print_json({**found.to_json(), "assumed": read.assumed})
    else:
        from upright.service.pages.diagnose import print_diagnosis

        print_diagnosis(found, seconds)
        if pages:
            page.print("\n" + "\n".join(f"Report: {path}" for path in pages))
        if auto is not None and found.revised is not None:
            page.print(f"\nModel: {auto}, with a record of all steps: {auto.with_suffix('.trail.json')}")
    if found.verdict is Verdict.INSUFFICIENT_DATA or not found.steps:
        raise typer.Exit(1)
    return found
