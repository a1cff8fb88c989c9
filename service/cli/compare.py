"""`upright compare`: compare models with recordings, and show where they fail."""

from __future__ import annotations

import json as json_module
import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from service.cli.arguments import AssumeOption, FromOption, MapOption, RecordingsArgument, ToOption, VehicleOption
from service.output import check_folder, page, people, print_json

if TYPE_CHECKING:
    from models.model import Model
    from vehicles.file import VehicleFile

CAD = "CAD"


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
        ),
    ] = None,
    begin: FromOption = 0.0,
    end: ToOption = math.inf,
    map_: MapOption = None,
    assume: AssumeOption = None,
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
    from diagnosis.prediction.compare import compare as run
    from service.cli.inputs import load_recordings, working
    from service.cli.pages.compare import print_comparisons
    from service.offline.diagnose import asked_of
    from service.offline.machine import is_of, name_of, support_of
    from service.offline.models import columns
    from service.offline.provenance import assumed
    from telemetry.tables.mapping import said_of
    from vehicles.file import load
    from vehicles.load import with_load
    from vehicles.registry import recorded_loop

    if picture is not None:
        from diagnosis.report.figures.methods import check_suffix

        check_suffix(picture)
    check_folder(report)
    file = load(vehicle)
    models = read_models(model or [], file)
    user = said_of(
        map_ or [], assume or [], {name: each for option in model or [] for name, each in columns(option).items()}
    )
    subject = next(iter(models.values()))
    support = support_of(subject, file)
    answers = []
    pictures = []
    with working() as step:
        loaded_all = load_recordings(recordings, file, list(models.values()), user=user, begin=begin, end=end)
        if asked := asked_of(subject, loaded_all, user.settled, support):
            raise asked
        for recording in loaded_all:
            path = Path(recording.source)
            step(f"comparing: {path.name}")
            loops = [recorded_loop(file, recording)] if is_of(subject, file) else []
            loaded = {name: with_load(each, recording) for name, each in models.items()}
            found = run(loaded, [recording], support=support, loops=loops, progress=step)
            answers.append((path, found))
            if picture is not None:
                from diagnosis.report.figures.comparison import save_comparison

                step(f"drawing: {path.name}")
                target = picture if len(loaded_all) == 1 else picture.with_stem(f"{picture.stem}_{path.stem}")
                save_comparison(found, target)
                pictures.append(target)
        if report is not None:
            from diagnosis.report import write_comparison
            from service.offline.provenance import provenance

            origin = provenance(name_of(subject, file), recordings, loaded_all)
            named = [(str(path), found) for path, found in answers]
            report.write_text(write_comparison(named, provenance=origin, progress=step), encoding="utf-8")
    if json:
        print_json(
            {
                "models": [{**each.to_json(), "recording": str(path)} for path, found in answers for each in found],
                "assumed": assumed(loaded_all),
            }
        )
        return
    for path, found in answers:
        print_comparisons(found, title=path.name)
    for target in pictures:
        page.print(f"Picture: {target}")
    if report is not None:
        page.print(f"Report: {report}")


def read_models(options: list[str], vehicle: VehicleFile) -> dict[str, Model]:
    """The models of `--model` by name, after the vehicle's own with its CAD values if one of them is of the vehicle.

    Raises ModelError and RecordingError for options that are not models, and EstimationError if none is given and the
    vehicle has no model of its own.
    """
    from estimators.contract import EstimationError
    from service.offline.machine import is_of
    from service.offline.models import identified_model

    models: dict[str, Model] = {}
    try:
        models[CAD] = identified_model(None, vehicle)
    except EstimationError:
        if not options:
            raise
    for option in options:
        read = estimated(Path(option), models.get(CAD)) if option.endswith(".json") else {}
        if not option.endswith(".json"):
            read[Path(option).stem if option.endswith(".toml") else option] = identified_model(option, vehicle)
        for name, each in read.items():
            models[name if name not in models else f"{name} ({Path(option).name})"] = each
    given = {name: each for name, each in models.items() if name != CAD}
    return given if given and not any(is_of(each, vehicle) for each in given.values()) else models


def estimated(path: Path, base: Model | None) -> dict[str, Model]:
    """Models by name from a JSON file of estimates: `base` with the estimates of each method, or, from the output of
    `upright model add --json`, the model before the addition, fitted to the same recordings.

    Raises RecordingError if the file has no estimates, or if no model is known that they belong to; ModelError if the
    model file to which an effect was added does not exist any more, or does not have the effect.
    """
    from telemetry.errors import RecordingError

    models = {}
    try:
        document = json_module.loads(path.read_text())
        if "repair" in document:
            return {f"without {document['effect']}": _without_effect(document)}
        if base is None:
            remedy = "Give the model itself: --model FILE.toml."
            raise RecordingError(str(path), "", "has parameter values, but their model is not known", remedy=remedy)
        names = {parameter.name for parameter in base.parameters}
        methods: dict[str, Any] = document.get("methods") or document.get("estimates") or document
        for name, method in methods.items():
            values = {key: entry["value"] for key, entry in method["parameters"].items() if entry["value"] is not None}
            strange = [key for key in values if "." in key and key not in names]
            if strange:
                people.print(f"[yellow]{path.name}, {name}: {base.name} has no {', '.join(strange)}, left out[/yellow]")
            elif not names.isdisjoint(values):
                models[name] = base.change({key: value for key, value in values.items() if key in names})
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise RecordingError(
            str(path),
            "",
            f"has no estimates ({error})",
            remedy="Write one with `upright identify ... --json > FILE`.",
        ) from error
    return models


def _without_effect(document: dict[str, Any]) -> Model:
    """The model of the file to which `upright model add` added an effect, without it and with the values fitted so."""
    from models.file.model_file import load_model

    values = {name: each["value"] for name, each in document["repair"]["before"]["parameters"].items()}
    return load_model(document["file"]).remove(document["effect"]).change(values)


def estimates_beside(recording: Path) -> Path:
    """The file of the live estimates of `recording`."""
    return recording.with_suffix(".estimates.json")
