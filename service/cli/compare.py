"""`upright compare`: compare models with recordings, and show where they fail."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated

import typer

from upright.service.cli.arguments import (
    AssumeOption,
    DbcOption,
    FromOption,
    MapOption,
    RecordingsArgument,
    ToOption,
    VehicleOption,
    models,
)
from upright.service.output import check_folder, page, people, print_json
from upright.service.whole_file import write_whole


def compare(
    recordings: RecordingsArgument,
    vehicle: VehicleOption = "monocab",
    model: Annotated[
        list[str] | None,
        typer.Option(
            "--model",
            help="A model file (.toml), a shipped model, or JSON with parameters: the .estimates.json beside a"
            " recording, or the output of `upright model add --json` (for the model before the addition). May be given"
            " several times.",
            show_default="the vehicle's with its CAD values",
            autocompletion=models,
        ),
    ] = None,
    begin: FromOption = 0.0,
    end: ToOption = math.inf,
    map_: MapOption = None,
    assume: AssumeOption = None,
    dbc: DbcOption = None,
    picture: Annotated[
        Path | None,
        typer.Option("--picture", help="Picture of the overlay and of where the models fail: .png, .svg or .pdf."),
    ] = None,
    report: Annotated[
        Path | None,
        typer.Option("--report", help="Write a self-contained page to read, mail and print: FILE.html."),
    ] = None,
    json: Annotated[bool, typer.Option("--json", help="One JSON document on stdout.")] = False,
) -> None:
    """Compare models with recordings: how well they predict, which force is missing, and where.

    Each recording is compared by itself. The reference is the error that noise alone would cause; the noise is
    estimated from the recording.
    """
    from upright.service.cli.inputs import load_recordings, working
    from upright.service.offline.compare import compared
    from upright.service.offline.inputs.machine import name_of
    from upright.service.offline.models import columns, compared_models
    from upright.service.offline.provenance import assumed, provenance
    from upright.service.pages.compare import print_comparisons
    from upright.telemetry.tables.mapping import said_of
    from upright.vehicles.file import load

    if picture is not None:
        from upright.diagnosis.report.figures.methods import check_suffix

        check_suffix(picture)
    check_folder(report)
    file = load(vehicle)
    chosen = compared_models(model or [], file, note=lambda text: people.print(f"[yellow]{text}[/yellow]"))
    written = {name: each for option in model or [] for name, each in columns(option).items()}
    user = said_of(map_ or [], assume or [], written)
    answers = []
    pictures = []
    with working() as step:
        loaded = load_recordings(recordings, file, list(chosen.values()), user=user, begin=begin, end=end, database=dbc)
        for recording, found in zip(loaded, compared(loaded, chosen, file, step), strict=True):
            path = Path(recording.source)
            answers.append((path, found))
            if picture is not None:
                from upright.diagnosis.report.figures.comparison import save_comparison

                step(f"drawing: {path.name}")
                target = picture if len(loaded) == 1 else picture.with_stem(f"{picture.stem}_{path.stem}")
                save_comparison(found, target)
                pictures.append(target)
        if report is not None:
            from upright.diagnosis.report import write_comparison

            origin = provenance(name_of(next(iter(chosen.values())), file), recordings, loaded)
            named = [(str(path), found) for path, found in answers]
            write_whole(report, write_comparison(named, provenance=origin, progress=step))
    if json:
        print_json(
            {
                "models": [{**each.to_json(), "recording": str(path)} for path, found in answers for each in found],
                "assumed": assumed(loaded),
            }
        )
        return
    for path, found in answers:
        print_comparisons(found, title=path.name)
    for target in pictures:
        page.print(f"Picture: {target}")
    if report is not None:
        page.print(f"Report: {report}")
