"""`upright design`: the controllers for a result of the identification, checked, predicted, and adopted on request."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from upright.service.cli.arguments import VehicleOption, methods, models
from upright.service.output import page, print_json

if TYPE_CHECKING:
    from upright.service.offline.design import Designed, Result
    from upright.vehicles.file import VehicleFile


def register(app: typer.Typer) -> None:
    """Add the command of this module to `app`."""
    app.command(
        epilog="Example: `upright identify recordings/*.arrow --json > result.json`, then `upright design result.json`,"
        " then `upright design result.json --use`"
    )(design)


def design(
    result: Annotated[
        Path | None,
        typer.Argument(
            help="The output of `upright identify --json`, or a model file (.toml). Without one, what is in use.",
            show_default=False,
        ),
    ] = None,
    vehicle: VehicleOption = "monocab",
    method: Annotated[
        str | None,
        typer.Option(
            "--method", "-m", help="Method of the result.", show_default="the recommended one", autocompletion=methods
        ),
    ] = None,
    model: Annotated[
        str | None,
        typer.Option(
            "--model", help="The model that `identify` was given.", show_default="the vehicle's", autocompletion=models
        ),
    ] = None,
    use: Annotated[
        bool, typer.Option("--use", help="Let the daemon use these controllers from the next experiment on.")
    ] = False,
    back: Annotated[
        bool, typer.Option("--back", help="Let the daemon use the controllers again that it used before.")
    ] = False,
    socket: Annotated[
        Path | None, typer.Option("--socket", help="The daemon's control socket.", show_default=False)
    ] = None,
    json: Annotated[bool, typer.Option("--json", help="One JSON document on stdout.")] = False,
) -> None:
    """Design the vehicle's controllers for identified parameters, and predict its experiments with them.

    Each controller has to be stable wherever the parameters may be: in the corners of the 95 % region of the estimates
    and at 1,000 draws from it, with the effects that the model has. Otherwise it is refused, with the corner. Nothing
    acts before `--use`.
    """
    from upright.service.offline.design import designed, read_result
    from upright.vehicles.file import load

    if use and back:
        raise typer.BadParameter("give one of the two", param_hint="--use, --back")
    if result is None or back:
        if use or (back and result is not None):
            hint = "--use" if use else "--back"
            raise typer.BadParameter("needs a result" if use else "takes no result", param_hint=hint)
        request = {"verb": "design", "back": True} if back else {"verb": "status"}
        answer = _ask(request, load(vehicle).vehicle.id, socket)
        acting = answer["design"] if back else answer["status"]["design"]
        if json:
            print_json({"in_use": acting})
        else:
            page.print(f"The controllers are designed for the parameters of {acting['text']}.")
            for name, value in acting["values"].items():
                page.print(f"  {name} {value:.6g}")
        return
    file = load(vehicle)
    read = read_result(result, file, method, model)
    found = designed(file, read)
    adopted = _ask(read.request, file.vehicle.id, socket) if use else None
    if json:
        document = {"source": read.source, "sha256": read.sha256, "values": dict(read.values), "how": read.how}
        print_json({**document, **found.to_json(), "in_use": adopted["design"] if adopted else None})
        return
    _print(file, read, found)
    page.print(f"\n{adopted['text']}" if adopted else f"\nNothing has changed yet: `upright design {result} --use`.")


def _print(file: VehicleFile, read: Result, found: Designed) -> None:
    from rich.table import Table

    from upright.estimators.numbers import common

    page.print(f"Parameters: {read.how}")
    cad, theirs = file.parameters, found.vehicle.parameters
    table = Table("parameter", "vehicle file", "designed for", "±", "unit")
    for name, value in theirs.values.items():
        given, std = cad.values[name], theirs.deviations[name]
        scale = common([(value, std), (given, None)], getattr(theirs, name).unit)
        table.add_row(name, scale.text(given), *scale.pair(value, std), scale.unit)
    page.print(table)
    for line in found.words():
        page.print(f"  {line}")
    table = Table("experiment", "controller", "largest, of its limit", title="Predicted", title_justify="left")
    for each in found.expected:
        sizes = ", ".join(f"{name} {value:.3g} of {limit:.3g} {unit}" for name, value, limit, unit in each.largest)
        table.add_row(each.name, each.controller, "; ".join(filter(None, (sizes, each.broken))))
    page.print(table)


def _ask(request: dict[str, Any], vehicle: str, socket: Path | None) -> dict[str, Any]:
    """The daemon's answer. Exits with its exit code if it refuses."""
    from upright.service.control.clients import api
    from upright.service.output import people

    answer = list(api.call([socket] if socket else api.socket_candidates(vehicle), request, timeout=30.0))[-1]
    if answer["exit_code"]:
        people.print(answer["text"])
        raise typer.Exit(answer["exit_code"])
    return answer
