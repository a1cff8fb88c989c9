"""Commands that look after the computer: doctor, bundle."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from upright.service.cli.arguments import VEHICLES
from upright.service.cli.inputs import working
from upright.service.output import check_folder, page, print_json

if TYPE_CHECKING:
    from collections.abc import Iterable

    from upright.service.doctor.checks import Check, Finding, Status

OptionalVehicle = Annotated[
    str | None,
    typer.Argument(metavar="VEHICLE", help=VEHICLES, show_default="/etc/upright/vehicle.toml, if it is there"),
]
SocketOption = Annotated[Path | None, typer.Option("--socket", help="The daemon's control socket.", show_default=False)]
DataOption = Annotated[
    Path | None, typer.Option("--data", help="Folder of the recordings.", show_default="the daemon's, else recordings")
]
JsonOption = Annotated[bool, typer.Option("--json", help="One JSON document on stdout.")]
STYLES = {"ok": "green", "not_known": "dim", "warning": "yellow", "problem": "bold red"}


def register(app: typer.Typer) -> None:
    """Add the commands of this module to `app`."""
    app.command(epilog="Example: `upright doctor my_vehicle.toml`")(doctor)
    app.command(epilog="Example: `upright bundle my_vehicle.toml --recordings 1`")(bundle)


def doctor(
    vehicle: OptionalVehicle = None, socket: SocketOption = None, data: DataOption = None, json: JsonOption = False
) -> None:
    """Check this computer: kernel, CAN, permissions, clock, real-time limits, disk, versions, broker.

    Each finding comes with its remedy, a command where there is one. Nothing is changed, and the vehicle is not moved.
    Exit code 1 if there is a problem; a warning is none.
    """
    from upright.service.doctor.checks import Status, examine, worst
    from upright.service.doctor.collect import Subject, collect

    with working() as step:
        facts, _ = collect(Subject(vehicle, socket, data), step)
    found = examine(facts)
    status = worst(finding for _, finding in found)
    if json:
        print_json(as_document(found, status))
    else:
        for check, finding in found:
            page.print(f"{finding.status.replace('_', ' '):>9}", style=STYLES[finding.status], end="  ")
            page.print(f"{check.title}: {finding.text}", markup=False, soft_wrap=True)
            if finding.remedy:
                page.print(f"{'':9}  -> {finding.remedy}", markup=False, soft_wrap=True)
        statuses = [finding.status for _, finding in found]
        counts = {each: statuses.count(each) for each in (Status.PROBLEM, Status.WARNING)}
        page.print(", ".join(f"{count} {each}{'s' if count != 1 else ''}" for each, count in counts.items()) + ".")
    if status is Status.PROBLEM:
        raise typer.Exit(1)


def bundle(
    vehicle: OptionalVehicle = None,
    recordings: Annotated[int, typer.Option(min=0, help="How many recordings, the newest first.")] = 3,
    log: Annotated[
        list[Path] | None,
        typer.Option("--log", help="A log file to pack as well, for a daemon that is no service.", show_default=False),
    ] = None,
    output: Annotated[
        Path | None,
        typer.Option("--output", help="The archive.", show_default="upright-bundle-VEHICLE-TIME.tar.gz, here"),
    ] = None,
    most: Annotated[int, typer.Option("--most", min=1, help="Largest size of the archive, MB.")] = 200,
    socket: SocketOption = None,
    data: DataOption = None,
    json: JsonOption = False,
) -> None:
    """Pack what somebody needs to help: logs, configuration, recordings, versions, and the findings of the doctor.

    Passwords and tokens are left out. Look into the archive before it is sent: `contents.json` lists what is in it.
    """
    from dataclasses import asdict
    from datetime import UTC, datetime

    from upright.service.doctor.bundle import Wanted, pack
    from upright.service.doctor.checks import examine, worst
    from upright.service.doctor.collect import Subject, collect, loaded, path_of
    from upright.service.doctor.facts import NotKnown

    check_folder(output)
    if output is not None and output.exists():
        raise typer.BadParameter(f"{output} exists", param_hint="--output")
    subject = Subject(vehicle, socket, data)
    with working() as step:
        facts, daemon = collect(subject, step)
        file = loaded(subject)
        found = examine(facts)
        judged = as_document(found, worst(each for _, each in found))
        documents = {"doctor": {**judged, "facts": asdict(facts)}, "status": daemon}
        name = file.vehicle.id if file is not None else "computer"
        folder = data or Path("recordings" if isinstance(facts.disk, NotKnown) else facts.disk.folder)
        wanted = Wanted(
            data=folder,
            recordings=recordings,
            limit=most * 1_000_000,
            logs=tuple(log or ()),
            vehicle=file,
            vehicle_path=path_of(subject),
            daemon=None if isinstance(facts.daemon, NotKnown) else facts.daemon.pid,
        )
        path = output or Path(f"upright-bundle-{name}-{datetime.now(UTC):%Y%m%d-%H%M%S}.tar.gz")
        packed = pack(path, wanted, documents, step)
    if json:
        files = [each["file"] for each in packed.files]
        print_json({"archive": str(path), "bytes": packed.size, "packed": files, "left_out": packed.left_out})
        return
    page.print(f"Packed {len(packed.files)} files, {packed.size / 1e6:.1f} MB:")
    for entry in packed.files:
        page.print(f"  {entry['bytes'] / 1e3:9.1f} kB  {entry['file']}", markup=False)
    for entry in packed.left_out:
        page.print(f"  left out: {entry['file']}: {entry['why']}", markup=False, soft_wrap=True)
    page.print(f"{path}\nKnown passwords and tokens were removed. Look into it before you send it.", markup=False)


def as_document(found: Iterable[tuple[Check, Finding]], status: Status) -> dict[str, Any]:
    """The document of `upright doctor --json`."""
    return {
        "status": status.value,
        "checks": [
            {"check": check.name, "status": finding.status.value, "text": finding.text, "remedy": finding.remedy}
            for check, finding in found
        ],
    }
