"""Commands for vehicle files: config check, config show, config schema."""

from __future__ import annotations

from typing import Annotated

import typer
from rich.markup import escape

from upright.service.cli.arguments import VehicleArgument
from upright.service.output import page, print_json

config = typer.Typer(help="Check and show vehicle files, and list all their keys.", no_args_is_help=True)

JsonOption = Annotated[bool, typer.Option("--json", help="One JSON document on stdout.")]


def register(app: typer.Typer) -> None:
    """Add the commands of this module to `app`."""
    app.add_typer(config, name="config")


@config.command(epilog="Example: `upright config check my_vehicle.toml`")
def check(file: VehicleArgument, json: JsonOption = False) -> None:
    """Check a vehicle file: keys, units, CAN ids, the EDS of each drive, bus load, and robustness of the controller.

    With exit code 1 the first wrong key and the remedy are printed. What is wrong in an EDS but does no harm is a note.
    """
    from upright.drivers.cia402 import eds
    from upright.service.control import assembly
    from upright.service.control.cycle.sequence import plan
    from upright.vehicles import registry
    from upright.vehicles.drives import drive_config
    from upright.vehicles.file import load

    vehicle = load(file)
    kind = registry.kind_of(vehicle, assembly.vehicle_io(vehicle))
    pilot = kind.pilot()
    plans = {name: plan(vehicle, name, pilot, kind.angle) for name in vehicle.experiments}
    load_percent = assembly.bus_load(vehicle)
    sheets: dict[str, list[str]] = {}
    for section in vehicle.drive:
        eds.load(drive_config(vehicle, section), sheets.setdefault(section.name, []))
    if json:
        print_json({
            "file": vehicle.path,
            "vehicle": vehicle.vehicle.id,
            "configuration_hash": vehicle.configuration_hash,
            "bus_load_percent": load_percent,
            "eds": sheets,
            "controller": pilot.findings(),
            "experiments": {name: {"title": vehicle.experiments[name].title} for name in plans},
        })  # fmt: skip
        return
    page.print(f"[green]{vehicle.path} is valid[/green] (vehicle {vehicle.vehicle.id}, {vehicle.configuration_hash})")
    for bus, percent in load_percent.items():
        note = "  [yellow]too much: use a second bus, or fewer IMU slots[/yellow]" if percent > 70 else ""
        page.print(f"  bus {bus}: {percent:.0f} % of {vehicle.bus.bitrate / 1e3:.0f} kbit/s{note}")
    for name, notes in sheets.items():
        for note in notes:
            page.print(f"  [yellow]eds of drive {name}: {escape(note)}[/yellow]", soft_wrap=True)
    for line in pilot.words():
        page.print(f"  {line}")
    for name, each in plans.items():
        seconds = each.excitation.duration
        page.print(f"  experiment {name}: {vehicle.experiments[name].title}, {seconds:.0f} s of excitation")


@config.command(epilog="Example: `upright config show monocab --json`")
def show(file: VehicleArgument, json: JsonOption = False) -> None:
    """Show a vehicle file as it was read, including defaults."""
    from upright.vehicles.file import load

    vehicle = load(file)
    if json:
        print_json(vehicle.model_dump())
        return
    for section, content in vehicle.model_dump(exclude={"path", "configuration_hash"}).items():
        page.print(f"[bold]{section}[/bold]")
        entries = content.items() if isinstance(content, dict) else enumerate(content)
        for key, value in entries:
            page.print(f"  {key}: {value}", soft_wrap=True)


@config.command(epilog="Example: `upright config schema > vehicle.schema.json`")
def schema() -> None:
    """Print the JSON Schema of vehicle files: all keys with meaning and unit."""
    from upright.vehicles import file as vehicle_file

    print_json(vehicle_file.schema())
