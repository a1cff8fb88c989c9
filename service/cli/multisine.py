"""`upright multisine`: the excitation that determines the vehicle's parameters in the shortest time."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from upright.service.cli.arguments import VehicleOption
from upright.service.output import check_folder, page, print_json
from upright.service.whole_file import write_whole

if TYPE_CHECKING:
    from upright.service.offline.multisine import DesignedMultisine


def register(app: typer.Typer) -> None:
    """Add the command of this module to `app`."""
    app.command(
        epilog="Example: `upright multisine --duration 20 --write designed.toml`, whose section you copy into the"
        " vehicle file. After a first identification: `upright multisine result.json`"
    )(multisine)


def multisine(
    result: Annotated[
        Path | None,
        typer.Argument(help="The output of `upright identify --json`, or a model file.", show_default="the CAD values"),
    ] = None,
    vehicle: VehicleOption = "monocab",
    parameter: Annotated[
        list[str] | None,
        typer.Option(
            "--parameter",
            "-p",
            help="A parameter in question; may be given several times.",
            show_default="all estimated",
        ),
    ] = None,
    duration: Annotated[float, typer.Option(help="s.", min=5.0, max=600.0)] = 30.0,
    start: Annotated[float, typer.Option(help="Hz, lowest line.", min=0.01)] = 0.1,
    stop: Annotated[float, typer.Option(help="Hz, highest line.", min=0.02)] = 3.0,
    lines: Annotated[int, typer.Option(help="Number of lines to choose from.", min=2, max=200)] = 24,
    share: Annotated[
        float, typer.Option("--of-limits", help="Share of each limit that may be used, 0 to 0.8.", min=0.01, max=0.8)
    ] = 0.5,
    write: Annotated[
        Path | None, typer.Option("--write", help="Write the section for the vehicle file to FILE.toml.")
    ] = None,
    json: Annotated[bool, typer.Option("--json", help="One JSON document on stdout.")] = False,
) -> None:
    """Design the multisine that determines the vehicle's parameters best within its limits.

    It is predicted in the closed loop with the vehicle's controller, and simulated with the parameters wherever they
    may be, so that no limit is reached. Nothing moves: copy the section into the vehicle file to run it.
    """
    from upright.service.cli.inputs import share_done
    from upright.service.offline.design import read_result
    from upright.service.offline.models import identified_model
    from upright.service.offline.multisine import designed_multisine
    from upright.vehicles.file import load

    check_folder(write)
    if not start < stop:
        raise typer.BadParameter(f"{stop:g} Hz is not above {start:g} Hz", param_hint="--stop")
    file = load(vehicle)
    model = identified_model(None, file)
    if result is not None:
        read = read_result(result, file)
        known = {name: std for name, std in read.deviations.items() if name in read.model.values}
        model = read.model.change(deviations=known)
    with share_done() as progress:
        found = designed_multisine(
            file,
            model,
            about=parameter or (),
            duration=duration,
            start=start,
            stop=stop,
            lines=lines,
            share=share,
            progress=progress,
        )
    if write is not None:
        write_whole(write, found.toml)
    if json:
        print_json(found.to_json())
    else:
        _print(found, write)


def _print(found: DesignedMultisine, write: Path | None) -> None:
    from rich.table import Table

    own = found.candidates[0]
    table = Table("experiment", "s", "least standard deviations", f"s of {own.name} for the same")
    for each in found.candidates:
        stds = ", ".join(f"{name} {each.deviations[name]:.3g}" for name in found.about)
        table.add_row(each.name, f"{each.seconds:g}", stds, f"{found.seconds_like(each.name):.1f}")
    page.print("Estimates from one run of each, with the noise that the model states:")
    page.print(table)
    page.print("Share of limits: " + ", ".join(f"{name} {100.0 * each:.0f} %" for name, each in found.largest.items()))
    page.print(f"\nFor the vehicle file: {write}" if write else "\n" + found.toml, markup=False)
