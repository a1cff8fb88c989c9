"""Commands for models: model show, list-effects, new, remove and allow; the others are in changed."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from upright.service.cli.arguments import effects, models, vehicles
from upright.service.cli.models import changed
from upright.service.output import page, print_json

model = typer.Typer(
    help="Models: their equations, and the physical effects that can be added to them.", no_args_is_help=True
)

ModelArgument = Annotated[str, typer.Argument(help="A shipped model (monocab_reduced) or a path to a model file.")]
FileArgument = Annotated[Path, typer.Argument(help="A model file, .toml.")]
JsonOption = Annotated[bool, typer.Option("--json", help="One JSON document on stdout.")]


class Format(StrEnum):
    """Output format of `model show`."""

    TEXT = "text"
    LATEX = "latex"
    JSON = "json"


def register(app: typer.Typer) -> None:
    """Add the commands of this module, and those of changed, to `app`."""
    changed.register(model)
    app.add_typer(model, name="model")


@model.command(epilog="Example: `upright model show monocab_reduced --effect coulomb_friction --format latex`")
def show(
    name: Annotated[
        str,
        typer.Argument(
            metavar="MODEL", help="A shipped model (monocab_reduced) or a model file.", autocompletion=models
        ),
    ],
    effect: Annotated[
        list[str] | None,
        typer.Option(
            "--effect",
            help="Show it with this effect: EFFECT or EFFECT@PLACE; may be given several times.",
            autocompletion=effects,
        ),
    ] = None,
    format: Annotated[Format, typer.Option("--format", help="Output format.")] = Format.TEXT,
    json: JsonOption = False,
) -> None:
    """Show a model: states, inputs, outputs, equations, parameters and effects.

    The equation of a joint contains the force of an effect by the effect's name. `:=` marks a command or a measurement
    that an effect replaces.
    """
    from upright.models import rendering
    from upright.models.file.document import ModelFile
    from upright.models.file.model_file import load_model, read

    file = read(name) if name.endswith(".toml") else ModelFile(load_model(name))
    shown = file.model
    for each in effect or []:
        wanted, _, at = each.partition("@")
        shown = shown.add(wanted, at)
    if json or format is Format.JSON:
        print_json({**rendering.to_json(shown), "history": file.history})
    elif format is Format.LATEX:
        typer.echo(rendering.latex(shown))
    else:
        from upright.service.pages.model import print_model

        print_model(shown, file.history)


@model.command(name="list-effects", epilog="Example: `upright model list-effects --family dry_friction`")
def list_effects(
    family: Annotated[
        str | None, typer.Option("--family", help="Only effects of this family of similar ones.", show_default="all")
    ] = None,
    json: JsonOption = False,
) -> None:
    """List the physical effects that a model may lack, with equation, parameters, and how to separate similar ones."""
    from rich.padding import Padding
    from rich.text import Text

    from upright.models.effect import Family
    from upright.models.effects.catalogue import CATALOGUE

    families = [each.value for each in Family]
    if family is not None and family not in families:
        raise typer.BadParameter(f"{family!r} is not one of {', '.join(families)}.", param_hint="--family")
    effects = [each for each in CATALOGUE.values() if family is None or each.family == family]
    if json:
        document = [
            {
                "name": each.name,
                "family": each.family.value,
                "title": each.title,
                "place": each.place.value,
                "equation": each.equation,
                "parameters": [
                    {"name": p.name, "unit": p.unit, "meaning": p.meaning, "amplitude": p.amplitude}
                    for p in each.parameters
                ],
                "signature": each.signature,
                "confused_with": list(each.confused_with),
                "separated_by": each.separated_by,
                "source": each.source,
            }
            for each in effects
        ]
        print_json({"effects": document})
        return
    for each in effects:
        page.print(f"[bold]{each.name}[/bold] ({each.family.value}, at a {each.place.value}): {each.title}")
        entries = {
            "equation": each.equation,
            "parameters": ", ".join(f"{p.name} ({_unit(p.unit)})" for p in each.parameters),
            "signature": each.signature,
            "confused with": ", ".join(each.confused_with),
            "separated by": each.separated_by,
        }
        for heading, text in entries.items():
            if text:
                page.print(Padding(Text(f"{heading}: {text}"), (0, 0, 0, 2)))


@model.command(epilog="Example: `upright model new mine.toml --base monocab_reduced --vehicle monocab`")
def new(
    file: FileArgument,
    base: Annotated[str, typer.Option("--base", help="The shipped model to start from.", autocompletion=models)],
    vehicle: Annotated[
        str | None,
        typer.Option(
            "--vehicle",
            "-v",
            help="A vehicle whose parameter values to use.",
            show_default="those of the base",
            autocompletion=vehicles,
        ),
    ] = None,
) -> None:
    """Write a new model file: a shipped model with the parameter values of a vehicle. It does not overwrite a file."""
    from dataclasses import replace

    from upright.models import library
    from upright.models.file.document import ModelFile
    from upright.models.file.model_file import parse, write
    from upright.models.parts import ModelError
    from upright.service.offline.model_files import now

    if file.suffix != ".toml":
        raise ModelError(str(file), "is not a name of a model file", remedy="use the suffix .toml.")
    if file.exists():
        raise ModelError(str(file), "already exists", remedy="choose another name, or remove it first.")
    start = library.get(base)
    entry = {"action": "new", "date": now()}
    if vehicle is not None:
        from upright.vehicles.file import load

        parameters = load(vehicle).parameters
        known = {parameter.name for parameter in start.parameters}
        values = {name: value for name, value in parameters.values.items() if name in known}
        start = start.change(values, deviations={name: parameters.deviations[name] for name in values})
        entry["vehicle"] = vehicle
    own_name = parse(f'base = "{base}"', file).model.name
    write(ModelFile(replace(start, name=own_name), (entry,)), file)
    page.print(f"{file}: {start.title}.", markup=False, soft_wrap=True)
    page.print(f"Add an effect with `upright model add {file} EFFECT`.", markup=False, soft_wrap=True)


@model.command(epilog="Example: `upright model remove mine.toml coulomb_friction`")
def remove(
    file: FileArgument,
    effect: Annotated[str, typer.Argument(help="One of the model's effects: EFFECT or EFFECT@PLACE.")],
    json: JsonOption = False,
) -> None:
    """Remove an effect from a model file, with a history entry."""
    from upright.service.offline.model_files import save, started, without_effect

    after = without_effect(started(file), effect)
    save(after, file)
    left = [attached.name for attached in after.model.effects]
    if json:
        print_json({"file": str(file), "removed": effect, "effects": left})
        return
    page.print(f"{file}: {effect} removed. Remaining effects: {', '.join(left) or 'none'}.", markup=False)


@model.command(epilog="Example: `upright model allow wind.py`")
def allow(
    file: Annotated[Path, typer.Argument(help="The Python file of an effect of your own, which you have read.")],
    json: JsonOption = False,
) -> None:
    """Allow the Python file of an effect to run, as it is now: it is code, and runs with your rights.

    It is known by its content, whatever its name. Once changed, it has to be allowed again.
    """
    from upright.models.file.allowed_code import allow as allow_file

    digest = allow_file(file)
    if json:
        print_json({"file": str(file), "sha256": digest})
        return
    page.print(f"{file} may run from now on. SHA-256: {digest}", markup=False, soft_wrap=True)


def _unit(template: str) -> str:
    """An effect's unit depends on where it acts: `{force}` is shown as `force`."""
    return template.replace("{", "").replace("}", "")
