"""`upright diagnose`: which physical effect a model lacks."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from service.cli.arguments import VehicleOption
from service.output import page, people, print_json

if TYPE_CHECKING:
    from diagnosis.diagnose import Diagnosis
    from diagnosis.report import Provenance
    from estimators.budget import Budget
    from models.effect import Effect
    from models.model import Model
    from telemetry.recording import Recording
    from vehicles.file import VehicleFile


SUFFIXES = (".toml", ".py")
"""Of a file with an effect of one's own."""
BUDGET, ROWS = 60.0, 12_000
"""s that a diagnosis of so many rows may take by default, of more rows in proportion."""
DIAGNOSIS = 0.85
"""Share of the time for the diagnosis itself: the rest is for the next experiment, and what sets in during the run."""
DRAWING = 0.1
"""Share that a report is left to be drawn in."""


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
    from diagnosis.diagnose import diagnose as run
    from diagnosis.parts import diagnose_parts
    from estimators.budget import Budget, OutOfTime
    from models.effects.catalogue import CATALOGUE
    from service.cli.inputs import identified_model, load_recording
    from service.offline.machine import is_of, name_of, support_of
    from service.offline.next_experiment import suggest_for
    from vehicles import registry
    from vehicles.file import load
    from vehicles.registry import recorded_loop

    for target in (auto, report):
        if target is not None and not target.absolute().parent.is_dir():
            raise typer.BadParameter(f"there is no folder {target.parent} to write {target.name} to")
    if budget is not None and not budget > 0.0:
        raise typer.BadParameter("has to be more than 0 s; inf is as long as it takes.", param_hint="--budget")
    file = load(vehicle)
    nominal = identified_model(model, file)
    if model is None:  # what identification assumes beside the vehicle's own equations is to be found here
        for attached in nominal.effects:
            nominal = nominal.remove(attached.name)
    support = support_of(nominal, file)
    actuators = registry.models_of(file).actuators if model is None else ()
    candidates: list[str | Effect] | None = [chosen(name) for name in effect] if effect else None
    if own:
        candidates = [*(candidates if candidates is not None else CATALOGUE), *map(chosen, own)]
    from_files = {chosen(name).name: Path(name) for name in (*(effect or ()), *(own or ())) if name.endswith(SUFFIXES)}
    loaded = [load_recording(path, vehicle).between(begin, end) for path in recordings]
    origin = provenance(name_of(nominal, file), recordings)  # of what was read: minutes later a file may be another
    seconds = default_budget(loaded) if budget is None else budget
    whole = Budget.of(None if math.isinf(seconds) else seconds * (1.0 if report is None else 1.0 - DRAWING))
    with share_done(whole) as progress:
        way = partial(diagnose_parts, nominal, actuators) if actuators else partial(run, nominal)
        of_vehicle = is_of(nominal, file)
        found = way(
            loaded,
            support=support,
            candidates=candidates,
            most=6 if auto else 3,
            budget=None if math.isinf(seconds) else DIAGNOSIS * whole.left,
            loops=[recorded_loop(file, each) for each in loaded] if of_vehicle else (),
            progress=progress,
        )
        parts = shown_parts(found, nominal, loaded, support)
        # Experiments are predicted for the vehicle, which its actuators only move.
        if parts[0][1] is nominal and of_vehicle:
            progress("choosing the next experiment", 1.0)
            try:
                suggested = suggest_for(file, parts[0][0], nominal, loaded, budget=whole)
                found = replace(found, suggested_experiment=suggested)
            except OutOfTime:
                found = replace(found, untried=(*found.untried, "the choice of the next experiment"))
        if found.verdict is Verdict.UNKNOWN and not found.findings and model is None:
            progress("looking for what sets in during the run", 1.0)
            try:
                found = replace(found, reason=f"{found.reason}{sets_in(loaded, recordings, file, begin, whole)}")
            except OutOfTime:
                found = replace(found, untried=(*found.untried, "what sets in during the run"))
        if report is not None:
            from diagnosis.report import write_report

            for (part, bare, seen), path in zip(parts, report_paths(report, len(parts)), strict=True):
                text = write_report(
                    replace(part, suggested_experiment=found.suggested_experiment, untried=found.untried),
                    bare,
                    seen,
                    support=support,
                    provenance=origin,
                    seconds=seconds,
                    progress=lambda text: progress(text, 1.0),
                )
                path.write_text(text, encoding="utf-8")
    if auto is not None and found.repaired is not None:
        from service.offline.trail import write_trail

        write_trail(auto, found, nominal, origin.hashes, from_files)
    if json:
        print_json(found.to_json())
    else:
        from service.cli.diagnose_page import print_diagnosis

        print_diagnosis(found, seconds)
        if report is not None:
            page.print("\n" + "\n".join(f"Report: {path}" for path in report_paths(report, len(parts))))
        if auto is not None and found.repaired is not None:
            page.print(f"\nModel: {auto}, and how it came about: {auto.with_suffix('.trail.json')}")
    if found.verdict is Verdict.INSUFFICIENT_DATA:
        raise typer.Exit(1)


def shown_parts(
    found: Diagnosis, nominal: Model, loaded: Sequence[Recording], support: float | None
) -> list[tuple[Diagnosis, Model, Sequence[Recording]]]:
    """What a report is on, with the bare model and the recordings of each: the vehicle, or else the part with the
    likeliest effect first, and the other one where it lacks something, too."""
    from diagnosis.prepare.actuator_samples import looked_at

    vehicle = (found.parts[0] if found.parts else found, nominal, loaded)
    if not found.parts or not found.parts[1].findings or not found.findings:
        return [vehicle]
    bare = found.parts[1].steps[0].model
    actuators = (found.parts[1], bare, looked_at(bare, loaded, support))
    told = [vehicle, actuators] if vehicle[0].findings else [actuators]
    return sorted(told, key=lambda each: found.findings[0] not in each[0].findings)


def report_paths(report: Path, count: int) -> list[Path]:
    """FILE.html, and for a second part FILE-2.html."""
    return [report, *(report.with_stem(f"{report.stem}-{number}") for number in range(2, count + 1))]


def default_budget(recordings: Sequence[Recording]) -> float:
    """s, where nothing else is asked for."""
    return BUDGET * max(1.0, sum(map(len, recordings)) / ROWS)


def sets_in(loaded: Sequence[Recording], paths: Sequence[Path], file: VehicleFile, begin: float, budget: Budget) -> str:
    """What does not act in all of a recording: no effect of a model does that, so that it has no name there.

    Raises OutOfTime.
    """
    from service.offline.replay import live_diagnosis
    from telemetry.errors import RecordingError

    told = ""
    for recording, path in zip(loaded, paths, strict=True):
        try:
            shown = live_diagnosis(recording, file, budget) or {"findings": []}
        except RecordingError:
            continue
        for each in shown["findings"][:1]:
            if each["since"]:
                since = math.ceil(begin + each["since"]) + 1
                told += (
                    f" {each['effect']} shows in {path.name} since {begin + each['since']:.0f} s: look at the rest"
                    f" of it alone, upright diagnose {path} --from {since}."
                )
    return told


def provenance(vehicle: str, recordings: list[Path]) -> Provenance:
    """Where a report comes from, for its foot."""
    from datetime import UTC, datetime
    from hashlib import sha256
    from importlib.metadata import version

    from diagnosis.report import Provenance

    hashes = {path.name: sha256(path.read_bytes()).hexdigest() for path in recordings}
    return Provenance(vehicle, version("upright"), datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC"), hashes)


def chosen(name: str) -> Effect:
    """An effect of the catalogue by name, or one's own from a file. Raises ModelError."""
    if name.endswith(SUFFIXES):
        from models.file.own_effects import load_effect

        return load_effect(Path(name))
    from models.effects.catalogue import find

    return find(name)


@contextmanager
def share_done(budget: Budget | None = None) -> Iterator[Callable[[str, float], None]]:
    """A progress bar of the share that is over, and of what is left of `budget`, on stderr."""
    from rich.progress import (
        BarColumn,
        Progress,
        ProgressColumn,
        Task,
        TaskProgressColumn,
        TextColumn,
        TimeElapsedColumn,
    )
    from rich.text import Text

    class Left(ProgressColumn):
        """The time that is left at most."""

        def render(self, task: Task) -> Text:
            return Text("" if budget is None or math.isinf(budget.ends) else f"{budget.left:.0f} s left at most")

    columns = (BarColumn(20), TaskProgressColumn(), TimeElapsedColumn(), Left(), TextColumn("{task.description}"))
    with Progress(*columns, console=people, transient=True) as progress:
        task = progress.add_task("reading", total=1.0)

        def told(text: str, share: float) -> None:
            progress.update(task, description=text, completed=share)

        yield told
