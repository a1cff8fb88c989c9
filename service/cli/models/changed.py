"""Commands that revise a model by means of recordings: model add, model undo, model drop-test."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.markup import escape

from upright.service.cli.arguments import effects, models, vehicles
from upright.service.output import page, people, print_json

if TYPE_CHECKING:
    from upright.diagnosis.revise.result import Revision
    from upright.models.effect import Effect
    from upright.models.file.document import ModelFile
    from upright.telemetry.recording import Recording
    from upright.vehicles.sections import VehicleFile

FileArgument = Annotated[Path, typer.Argument(help="A model file, .toml.")]
JsonOption = Annotated[bool, typer.Option("--json", help="One JSON document on stdout.")]
VehicleOption = Annotated[
    str | None,
    typer.Option(
        "--vehicle",
        "-v",
        help="A shipped vehicle or a vehicle file, for its support angle, and its CAD values for a shipped model.",
        show_default="from the recordings",
        autocompletion=vehicles,
    ),
]


def register(app: typer.Typer) -> None:
    """Add the commands of this module to `app`."""
    app.command(epilog="Example: `upright model add mine.toml coulomb_friction --recording recordings/step_1.arrow`")(
        add
    )
    app.command(epilog="Example: `upright model undo mine.toml`")(undo)
    app.command(name="drop-test", epilog="Example: `upright model drop-test mine.toml recordings/*.arrow`")(drop_test)


def add(
    name: Annotated[
        str, typer.Argument(metavar="MODEL", help="A model file, or a shipped model with -o.", autocompletion=models)
    ],
    effect: Annotated[
        str,
        typer.Argument(
            help="An effect of the catalogue, or the file of an effect of your own (.toml, .py).",
            autocompletion=effects,
        ),
    ],
    recording: Annotated[
        list[Path] | None,
        typer.Option("--recording", "-r", help="Fit the model to it; may be given several times.", show_default="none"),
    ] = None,
    held_out: Annotated[
        list[Path] | None,
        typer.Option(
            "--held-out",
            help="Validate the model on it, without fitting; may be given several times.",
            show_default="the last third of each recording",
        ),
    ] = None,
    vehicle: VehicleOption = None,
    at: Annotated[
        str, typer.Option("--at", help="Joint, actuator or sensor.", show_default="the first that can have it")
    ] = "",
    output: Annotated[
        Path | None, typer.Option("--output", "-o", help="Write this new file instead.", show_default="the model file")
    ] = None,
    picture: Annotated[
        Path | None, typer.Option("--picture", help="Picture of the errors before and after: .png, .svg or .pdf.")
    ] = None,
    json: JsonOption = False,
) -> None:
    """Add an effect to a model file, with a history entry.

    With recordings the model is fitted without and with the effect to all data that are not held out. The fitted values
    and standard deviations are written to the file, and the change of the error to its history. Without recordings the
    amplitudes of the effect are zero, at which it changes nothing.
    """
    from upright.service.offline.model_files import save, with_effect

    if not recording and (held_out or picture):
        raise typer.BadParameter("a --recording is required, to fit the model to.", param_hint="--held-out, --picture")
    if picture is not None:
        from upright.diagnosis.report.figures.methods import check_suffix

        check_suffix(picture)
    before, target = _start(name, vehicle), _target(name, output)
    after = with_effect(before, effect, at)
    found: Revision | None = None
    if recording:
        from upright.service.cli.models.history_entry import fit_entry, rounded

        wanted = after.model.effects[-1]
        found = _revise(before, wanted.effect, wanted.at, recording, held_out or [], vehicle)
        changed = rounded(found)
        entry = {**after.history[-1], **fit_entry(found, before.model, changed, recording, held_out or [])}
        after = replace(after, model=changed, history=(*before.history, entry))
    added = after.model.effects[-1]
    if found is not None and picture is not None:
        from upright.diagnosis.report.figures.revision import save_revision

        save_revision(found, picture)
    save(after, target)
    if json:
        document = {
            "file": str(target),
            "effect": added.name,
            "at": added.at,
            "parameters": {p.name: {"value": p.value, "std": p.std, "unit": p.unit} for p in added.parameters},
        }
        if found is not None:
            from upright.diagnosis.report.revision_words import in_words

            document["repair"] = {**found.to_json(), "words": in_words(found)}
        print_json(document)
        return
    from upright.service.pages.model import print_parameters

    page.print(f"{target}: {added.name} added at {added.at}: {added.effect.equation}", markup=False, soft_wrap=True)
    if found is None:
        print_parameters(added.parameters)
        return
    from upright.service.cli.pages.revision import print_revision

    print_revision(found)
    page.print(f"\nUndo it with `upright model undo {target}`.", markup=False, soft_wrap=True)
    if picture is not None:
        page.print(f"Picture: {picture}", markup=False, soft_wrap=True)


def undo(file: FileArgument, json: JsonOption = False) -> None:
    """Undo the last addition: remove the effect and its history entry, and restore the previous values.

    A parameter that has been changed by hand since then keeps its value.
    """
    from upright.models.file.history import undone
    from upright.models.file.model_file import read, write

    before = read(file)
    after, effect, kept = undone(before)
    write(after, file)
    left = [attached.name for attached in after.model.effects]
    if json:
        print_json({"file": str(file), "removed": effect, "effects": left, "kept": list(kept)})
        return
    page.print(
        f"{file}: {effect} removed. Remaining effects: {', '.join(left) or 'none'}.", markup=False, soft_wrap=True
    )
    if kept:
        page.print(f"Changed by hand since then, and kept: {', '.join(kept)}.", markup=False, soft_wrap=True)


def drop_test(
    file: FileArgument,
    recordings: Annotated[list[Path], typer.Argument(help="Recordings to fit the model to.")],
    vehicle: VehicleOption = None,
    json: JsonOption = False,
) -> None:
    """Fit the model without each of its effects in turn, to see which are needed and which can be removed."""
    from upright.diagnosis.revise.drop_tests import drop_tests
    from upright.models.file.history import before_fits
    from upright.models.file.model_file import read
    from upright.service.cli.inputs import working
    from upright.service.offline.inputs.machine import as_measured

    written = read(file)
    machine = _machine(vehicle)
    loaded = [_load(path, machine, written) for path in recordings]
    model = as_measured(before_fits(written), machine, loaded)
    support = None if machine is None else machine.support
    with working() as step:
        tests = drop_tests(model, loaded, support=support, progress=lambda text, share: step(text))
    if json:
        print_json({"file": str(file), "effects": [each.to_json() for each in tests]})
        return
    from upright.service.cli.pages.revision import print_drop_tests

    print_drop_tests(tests, str(file))


def _start(name: str, vehicle: str | None) -> ModelFile:
    """The model to add to: a model file, or a shipped model with the CAD values of the vehicle."""
    from upright.service.offline.model_files import started

    return started(name, None if name.endswith(".toml") else _machine(vehicle))


def _target(name: str, output: Path | None) -> Path:
    """The file to write. Raises ModelError if it cannot be written."""
    from upright.models.parts import ModelError

    if output is None:
        if not name.endswith(".toml"):
            raise ModelError(name, "is a shipped model and is not changed", remedy="name a new file: -o mine.toml.")
        return Path(name)
    if output.suffix != ".toml":
        raise ModelError(str(output), "is not a name of a model file", remedy="use the suffix .toml.")
    if output.exists() and not (name.endswith(".toml") and output.samefile(name)):
        raise ModelError(str(output), "already exists", remedy="choose another name, or remove it first.")
    return output


def _revise(
    file: ModelFile,
    effect: Effect | str,
    at: str,
    recordings: Sequence[Path],
    held_out: Sequence[Path],
    vehicle: str | None,
) -> Revision:
    from upright.diagnosis.revise.revision import revise
    from upright.models.file.history import before_fits
    from upright.service.cli.inputs import working
    from upright.service.offline.inputs.machine import as_measured
    from upright.vehicles.experiment.load import refuse_loads

    machine = _machine(vehicle)
    support = None if machine is None else machine.support
    training, tried = ([_load(path, machine, file) for path in paths] for paths in (recordings, held_out))
    refuse_loads((*training, *tried))
    model = as_measured(before_fits(file), machine, (*training, *tried))
    with working() as step:
        return revise(
            model,
            effect,
            training,
            tried,
            at=at,
            support=support,
            progress=lambda text, share: step(f"{text} ({100.0 * share:.0f} %)"),
        )


def _machine(vehicle: str | None) -> VehicleFile | None:
    from upright.vehicles.file import load

    return None if vehicle is None else load(vehicle)


def _load(path: Path, machine: VehicleFile | None, file: ModelFile) -> Recording:
    from upright.service.offline.inputs.read import read
    from upright.telemetry.tables.mapping import Said, columns_of

    found, notes = read(path, machine, [file.model], Said(columns_of(file.columns)))
    for note in notes:
        people.print(f"[yellow]{escape(f'{path}: {note}')}[/yellow]")
    return replace(found, source=path.name)
