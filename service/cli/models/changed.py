"""Commands that revise a model by means of recordings: model add, model undo, model drop-test."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from service.output import page, print_json

if TYPE_CHECKING:
    from diagnosis.revise.result import Revision
    from models.effect import Effect
    from models.file.document import ModelFile
    from telemetry.recording import Recording

FileArgument = Annotated[Path, typer.Argument(help="A model file, .toml.")]
JsonOption = Annotated[bool, typer.Option("--json", help="One JSON document on stdout.")]
VehicleOption = Annotated[
    str | None,
    typer.Option(
        "--vehicle",
        "-v",
        help="A shipped vehicle or a vehicle file, for its support angle, and its CAD values for a shipped model.",
        show_default="from the recordings",
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
    name: Annotated[str, typer.Argument(metavar="MODEL", help="A model file, or a shipped model with -o.")],
    effect: Annotated[
        str, typer.Argument(help="An effect of the catalogue, or the file of an effect of your own (.toml, .py).")
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
    import os

    from models.file.model_file import write
    from models.file.own_effects import load_effect

    if not recording and (held_out or picture):
        raise typer.BadParameter("a --recording is required, to fit the model to.", param_hint="--held-out, --picture")
    if picture is not None:
        from diagnosis.report.figures.methods import check_suffix

        check_suffix(picture)
    before, target = _start(name, vehicle), _target(name, output)
    files = {own: _from(target, _found(name, path)) for own, path in before.effect_files.items()}
    own_file = effect.endswith((".toml", ".py"))
    own_sha256 = {"effect_sha256": _sha256(effect)} if own_file else {}
    wanted: Effect | str = load_effect(Path(effect)) if own_file else effect
    name_there = before.model.add(wanted, at).effects[-1].name
    entry: dict[str, Any] = {"action": "add", "effect": name_there, "date": _now(), **own_sha256}
    found: Revision | None = None
    if recording:
        from service.cli.models.history_entry import fit_entry, rounded

        found = _revise(before, wanted, at, recording, held_out or [], vehicle)
        changed = rounded(found)
        entry |= fit_entry(found, before.model, changed, recording, held_out or [])
    else:
        changed = before.model.add(wanted, at)
    added = changed.effects[-1]
    if own_file:
        files[added.name] = os.path.relpath(effect, target.resolve().parent)
    if found is not None and picture is not None:
        from diagnosis.report.figures.revision import save_revision

        save_revision(found, picture)
    write(replace(before, model=changed, history=(*before.history, entry), effect_files=files), target)
    if json:
        document = {
            "file": str(target),
            "effect": added.name,
            "at": added.at,
            "parameters": {p.name: {"value": p.value, "std": p.std, "unit": p.unit} for p in added.parameters},
        }
        if found is not None:
            from diagnosis.report.revision_words import in_words

            document["repair"] = {**found.to_json(), "words": in_words(found)}
        print_json(document)
        return
    from service.cli.pages.model import print_parameters

    page.print(f"{target}: {added.name} added at {added.at}: {added.effect.equation}", markup=False, soft_wrap=True)
    if found is None:
        print_parameters(added.parameters)
        return
    from service.cli.pages.revision import print_revision

    print_revision(found)
    page.print(f"\nUndo it with `upright model undo {target}`.", markup=False, soft_wrap=True)
    if picture is not None:
        page.print(f"Picture: {picture}", markup=False, soft_wrap=True)


def undo(file: FileArgument, json: JsonOption = False) -> None:
    """Undo the last addition: remove the effect and its history entry, and restore the previous values.

    A parameter that has been changed by hand since then keeps its value.
    """
    from models.file.history import undone
    from models.file.model_file import read, write

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
    from diagnosis.revise.drop_tests import drop_tests
    from models.file.history import before_fits
    from models.file.model_file import read
    from service.cli.inputs import working

    written = read(file)
    model, support = before_fits(written), _support(vehicle)
    loaded = [_load(path, vehicle, written) for path in recordings]
    with working() as step:
        tests = drop_tests(model, loaded, support=support, progress=lambda text, share: step(text))
    if json:
        print_json({"file": str(file), "effects": [each.to_json() for each in tests]})
        return
    from service.cli.pages.revision import print_drop_tests

    print_drop_tests(tests, str(file))


def _start(name: str, vehicle: str | None) -> ModelFile:
    """The model to add to: a model file, or a shipped model with the CAD values of the vehicle."""
    from models.file.document import ModelFile
    from models.file.model_file import load_model, read

    if name.endswith(".toml"):
        return read(name)
    model = load_model(name)
    if vehicle is not None:
        from estimators.identify.run import with_values
        from vehicles.file import load

        parameters = load(vehicle).parameters
        model = with_values(model, parameters.values, parameters.deviations)
    return ModelFile(model)


def _target(name: str, output: Path | None) -> Path:
    """The file to write. Raises ModelError if it cannot be written."""
    from models.parts import ModelError

    if output is None:
        if not name.endswith(".toml"):
            raise ModelError(name, "is a shipped model and is not changed", remedy="name a new file: -o mine.toml.")
        return Path(name)
    if output.suffix != ".toml":
        raise ModelError(str(output), "is not a name of a model file", remedy="use the suffix .toml.")
    if output.exists() and not (name.endswith(".toml") and output.samefile(name)):
        raise ModelError(str(output), "already exists", remedy="choose another name, or remove it first.")
    return output


def _found(name: str, path: str) -> Path:
    return Path(name).resolve().parent / path


def _from(target: Path, path: Path) -> str:
    import os

    return os.path.relpath(path, target.resolve().parent)


def _revise(
    file: ModelFile,
    effect: Effect | str,
    at: str,
    recordings: Sequence[Path],
    held_out: Sequence[Path],
    vehicle: str | None,
) -> Revision:
    from diagnosis.revise.revision import revise
    from models.file.history import before_fits
    from service.cli.inputs import working
    from vehicles.load import refuse_loads

    support = _support(vehicle)
    training, tried = ([_load(path, vehicle, file) for path in paths] for paths in (recordings, held_out))
    refuse_loads((*training, *tried))
    with working() as step:
        return revise(
            before_fits(file),
            effect,
            training,
            tried,
            at=at,
            support=support,
            progress=lambda text, share: step(f"{text} ({100.0 * share:.0f} %)"),
        )


def _support(vehicle: str | None) -> float | None:
    if vehicle is None:
        return None
    from vehicles.file import load

    return load(vehicle).support


def _load(path: Path, vehicle: str | None, file: ModelFile) -> Recording:
    from service.cli.inputs import load_recording
    from service.offline.wanted import wanted
    from telemetry.clock import with_regular_times
    from telemetry.storage import load
    from telemetry.tables.mapping import columns_of, said_of

    user = said_of((), (), columns_of(file.columns))
    if vehicle is None:
        found = with_regular_times(load(path, wanted([file.model]), user))
    else:
        found = load_recording(path, vehicle, user=user)
    return replace(found, source=path.name)


def _sha256(path: str) -> str:
    """Of the file of an effect; the file's own error is reported when it is read."""
    from models.file.allowed_code import sha256

    return sha256(Path(path).read_bytes()) if Path(path).is_file() else ""


def _now() -> Any:
    from datetime import UTC, datetime

    return datetime.now(UTC).replace(microsecond=0)
