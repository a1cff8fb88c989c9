"""`upright compare`: compare models with recordings, and show where they fail."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from service.cli.arguments import VehicleOption, models
from service.output import check_folder, page, people, print_json
from service.whole_file import write_whole


def compare(
    recordings: Annotated[list[Path], typer.Argument(help="Recordings: .arrow, .parquet, .csv, or a raw CAN .log.")],
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
    from service.cli.inputs import load_recording, working
    from service.offline.compare import compared
    from service.offline.machine import name_of
    from service.offline.models import compared_models
    from service.pages.compare import print_comparisons
    from vehicles.file import load

    if picture is not None:
        from diagnosis.report.figures.methods import check_suffix

        check_suffix(picture)
    check_folder(report)
    file = load(vehicle)
    chosen = compared_models(model or [], file, note=lambda text: people.print(f"[yellow]{text}[/yellow]"))
    answers = []
    pictures = []
    with working() as step:
        for path in recordings:
            step(f"reading: {path.name}")
            (found,) = compared([load_recording(path, vehicle)], chosen, file, step)
            answers.append((path, found))
            if picture is not None:
                from diagnosis.report.figures.comparison import save_comparison

                step(f"drawing: {path.name}")
                target = picture if len(recordings) == 1 else picture.with_stem(f"{picture.stem}_{path.stem}")
                save_comparison(found, target)
                pictures.append(target)
        if report is not None:
            from diagnosis.report import write_comparison
            from service.offline.provenance import provenance

            origin = provenance(name_of(next(iter(chosen.values())), file), recordings)
            named = [(str(path), found) for path, found in answers]
            write_whole(report, write_comparison(named, provenance=origin, progress=step))
    if json:
        print_json(
            {"models": [{**each.to_json(), "recording": str(path)} for path, found in answers for each in found]}
        )
        return
    for path, found in answers:
        print_comparisons(found, title=path.name)
    for target in pictures:
        page.print(f"Picture: {target}")
    if report is not None:
        page.print(f"Report: {report}")
