"""`upright diagnose`: which physical effect a model lacks."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from service.cli.arguments import VehicleOption
from service.output import page, print_json

if TYPE_CHECKING:
    from models.effect import Effect

DRAWING = 0.1
"""Share of the time that a report is left to be drawn in."""


def diagnose(
    recordings: Annotated[list[Path], typer.Argument(help="Recordings: .arrow, .parquet, .csv, or a raw CAN .log.")],
    vehicle: VehicleOption = "monocab",
    model: Annotated[
        str | None,
        typer.Option(
            "--model", help="A model file or a shipped model.", show_default="the vehicle's with its CAD values"
        ),
    ] = None,
    effect: Annotated[
        list[str] | None,
        typer.Option(
            "--effect",
            help="Look for this one: a name of the catalogue, or an effect of your own (.toml, .py). May be repeated.",
            show_default="the whole catalogue",
        ),
    ] = None,
    own: Annotated[
        list[str] | None,
        typer.Option("--also", help="An effect of your own (.toml, .py) beside the catalogue. May be repeated."),
    ] = None,
    begin: Annotated[
        float, typer.Option("--from", help="Look at the recordings from this second on.", show_default="the beginning")
    ] = 0.0,
    end: Annotated[
        float, typer.Option("--to", help="Look at the recordings up to this second.", show_default="the end")
    ] = math.inf,
    auto: Annotated[
        Path | None,
        typer.Option(
            "--auto",
            help="Add what is found, again and again, until the model is adequate or what is left has no name; write"
            " the model to this file, and the trail beside it.",
        ),
    ] = None,
    budget: Annotated[
        float | None,
        typer.Option(
            "--budget",
            help="Seconds that it may take, e.g. --budget 300; what is left untried by then is said. --budget inf: as"
            " long as it takes.",
            show_default="60, in proportion more for over 12,000 rows",
        ),
    ] = None,
    report: Annotated[
        Path | None,
        typer.Option("--report", help="A page to look at, to mail and to print: FILE.html, with nothing beside it."),
    ] = None,
    json: Annotated[bool, typer.Option("--json", help="One JSON document on stdout.")] = False,
) -> None:
    """Find the physical effect that a model lacks, or say that the recordings cannot tell.

    Of several recordings the last is held out to check on; of a single one each third in turn. A vehicle whose
    actuators have a model of their own is diagnosed in two parts, from command to motion and from there on; where both
    lack something, a second report is written beside the first. Ctrl-C ends it.
    """
    from diagnosis.diagnose import Verdict
    from models.effects.catalogue import CATALOGUE
    from service.cli.inputs import load_recording, share_done
    from service.offline.diagnose import default_budget, diagnosed
    from service.offline.machine import name_of
    from service.offline.models import SUFFIXES, chosen_effect
    from service.offline.provenance import provenance
    from vehicles.file import load

    for target in (auto, report):
        if target is not None and not target.absolute().parent.is_dir():
            raise typer.BadParameter(f"there is no folder {target.parent} to write {target.name} to")
    if budget is not None and not budget > 0.0:
        raise typer.BadParameter("has to be more than 0 s; inf is as long as it takes.", param_hint="--budget")
    file = load(vehicle)
    given = {name: chosen_effect(name) for name in (*(effect or ()), *(own or ()))}
    candidates: list[str | Effect] | None = [given[name] for name in effect] if effect else None
    if own:
        candidates = [*(candidates if candidates is not None else CATALOGUE), *(given[name] for name in own)]
    from_files = {each.name: Path(name) for name, each in given.items() if name.endswith(SUFFIXES)}
    loaded = [load_recording(path, vehicle).between(begin, end) for path in recordings]
    read = provenance("", recordings)  # of what was read: minutes later a file may be another
    seconds = default_budget(loaded) if budget is None else budget
    with share_done(seconds) as progress:
        answer = diagnosed(
            loaded,
            file,
            model=model,
            candidates=candidates,
            most=6 if auto else 3,
            seconds=seconds,
            reserved=0.0 if report is None else DRAWING,
            begin=begin,
            progress=progress,
        )
        found, origin = answer.found, replace(read, vehicle=name_of(answer.model, file))
        pages = report_paths(report, len(answer.parts)) if report is not None else []
        for part, path in zip(answer.parts, pages, strict=False):
            from diagnosis.report import write_report

            text = write_report(
                part.found,
                part.model,
                part.recordings,
                support=answer.support,
                provenance=origin,
                seconds=seconds,
                progress=lambda text: progress(text, 1.0),
            )
            path.write_text(text, encoding="utf-8")
    if auto is not None and found.revised is not None:
        from service.offline.trail import write_trail

        write_trail(auto, found, answer.model, origin.hashes, from_files)
    if json:
        print_json(found.to_json())
    else:
        from service.cli.pages.diagnose import print_diagnosis

        print_diagnosis(found, seconds)
        if pages:
            page.print("\n" + "\n".join(f"Report: {path}" for path in pages))
        if auto is not None and found.revised is not None:
            page.print(f"\nModel: {auto}, and how it came about: {auto.with_suffix('.trail.json')}")
    if found.verdict is Verdict.INSUFFICIENT_DATA:
        raise typer.Exit(1)


def report_paths(report: Path, count: int) -> list[Path]:
    """FILE.html, and for a second part FILE-2.html."""
    return [report, *(report.with_stem(f"{report.stem}-{number}") for number in range(2, count + 1))]
