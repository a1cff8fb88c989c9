"""Commands for a running daemon: experiment, stop, reset, status."""

from __future__ import annotations

import math
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any

import typer

from upright.service.output import live_estimates, missing_effects, page, people, print_json

VehicleOption = Annotated[str, typer.Option("--vehicle", "-v", help="Id of the vehicle whose daemon to use.")]
SocketOption = Annotated[Path | None, typer.Option("--socket", help="The daemon's control socket.", show_default=False)]
JsonOption = Annotated[bool, typer.Option("--json", help="One JSON document on stdout.")]


def register(app: typer.Typer) -> None:
    """Add the commands of this module to `app`."""
    app.command(epilog="Example: `upright experiment sweep`")(experiment)
    app.command(epilog="Example: `upright stop`. In an emergency use the e-stop, not this command.")(stop)
    app.command(epilog="Example: `upright reset`")(reset)
    app.command(epilog="Example: `upright status --json`")(status)


def experiment(
    names: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="NAME | RECORDINGS...",
            help="One of the vehicle file's experiments, as in `upright config show`; with --separate, recordings.",
            show_default=False,
        ),
    ] = None,
    separate: Annotated[
        tuple[str, str] | None,
        typer.Option(
            "--separate",
            metavar="EFFECT EFFECT",
            help="Run the experiment that separates these two in the shortest time, with the amplitudes found in the"
            " recordings, or else with the minimum detectable ones.",
            show_default=False,
        ),
    ] = None,
    begin: Annotated[
        float,
        typer.Option(
            "--from", help="With --separate: use the recordings from this second on.", show_default="the beginning"
        ),
    ] = 0.0,
    end: Annotated[
        float,
        typer.Option("--to", help="With --separate: use the recordings up to this second.", show_default="the end"),
    ] = math.inf,
    vehicle: VehicleOption = "monocab",
    socket: SocketOption = None,
    json: JsonOption = False,
) -> None:
    """Run an experiment on the vehicle: rise, settle, excite, lower. It is recorded and identified while it runs.

    Ctrl-C ends it in order: the vehicle is lowered onto its support. Exit code 3: refused by an interlock (the reasons
    are printed); 4: stopped by the safety verdict.
    """
    if separate is not None:
        from upright.service.cli.separate import chosen_experiment

        name, vehicle = chosen_experiment(separate, names or [], vehicle, begin, end)
    elif begin > 0.0 or end < math.inf:
        raise typer.BadParameter("applies to recordings, which require --separate", param_hint="--from, --to")
    elif names and len(names) == 1:
        name = names[0]
    else:
        raise typer.BadParameter("give one experiment, or two effects with --separate", param_hint="NAME")
    try:
        answer = follow(_call({"verb": "experiment", "name": name}, vehicle, socket))
    except KeyboardInterrupt:
        people.print("Interrupted: lowering the vehicle ...")
        answer = list(_call({"verb": "stop"}, vehicle, socket))[-1]
    if not json and answer.get("estimates"):
        page.print(live_estimates(answer["estimates"]))
    if not json and answer.get("recording"):
        page.print(missing_effects(answer.get("diagnosis")))
        page.print(f"Recording: {answer['recording']}")
    _finish(answer, json=json)


def stop(
    now: Annotated[
        bool, typer.Option("--now", help="Immediate quick stop: the vehicle falls onto its supports.")
    ] = False,
    vehicle: VehicleOption = "monocab",
    socket: SocketOption = None,
    json: JsonOption = False,
) -> None:
    """End the running experiment in order: the vehicle is lowered onto its support and the drives are disabled."""
    _finish(list(_call({"verb": "stop", "now": now}, vehicle, socket))[-1], json=json)


def reset(vehicle: VehicleOption = "monocab", socket: SocketOption = None, json: JsonOption = False) -> None:
    """Acknowledge a fault after its cause has been removed. Faults of the drives are reset; nothing is enabled."""
    _finish(list(_call({"verb": "reset"}, vehicle, socket))[-1], json=json)


def status(vehicle: VehicleOption = "monocab", socket: SocketOption = None, json: JsonOption = False) -> None:
    """Show the state of the daemon, the interlocks that prevent an experiment, and the estimated parameters."""
    answer = list(_call({"verb": "status"}, vehicle, socket))[-1]["status"]
    if json:
        print_json(answer)
        return
    page.print(f"[bold]{answer['vehicle']}[/bold]  {answer['mode']}  {answer['experiment'] or ''}")
    if answer["reason"]:
        page.print(f"  {answer['reason']}", style="bold red" if answer["mode"] == "fault" else None, markup=False)
    for interlock in answer["interlocks"]:
        page.print(f"  not ready: {interlock}")
    for reason in answer["stays_down"]:
        page.print(f"  not ready to get up: {reason}")
    for drive in answer["drives"]:
        page.print("  ".join([f"  {drive['name']}: {drive['state']}", drive["fault"], *drive["warnings"]]).rstrip())
    if answer["estimates"]:
        page.print(live_estimates(answer["estimates"]))
        page.print(missing_effects(answer["diagnosis"]))


def _call(request: dict[str, Any], vehicle: str, socket: Path | None) -> Iterator[dict[str, Any]]:
    from upright.service.control.clients import api

    timeout = None if request["verb"] == "experiment" else 30.0
    return api.call([socket] if socket else api.socket_candidates(vehicle), request, timeout=timeout)


def follow(messages: Iterator[dict[str, Any]]) -> dict[str, Any]:
    """Show phases, progress and live estimates of an experiment until its result, which is returned."""
    from rich.console import Group
    from rich.live import Live
    from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

    bar = Progress(TextColumn("{task.description}"), BarColumn(), TimeRemainingColumn(), console=people)
    task = bar.add_task("starting", total=1.0)
    last: dict[str, Any] = {}
    with Live(bar, console=people, refresh_per_second=5, transient=True) as live:
        for message in messages:
            last = message
            if message["type"] == "event":
                live.console.print(f"  {message['text']}")
                bar.update(task, description=message["text"])
            elif message["type"] == "progress":
                bar.update(task, completed=message["fraction"])
                if message["estimates"]:
                    shown = missing_effects(message["diagnosis"])
                    live.update(Group(bar, live_estimates(message["estimates"]), shown))
    return last


def _finish(answer: dict[str, Any], *, json: bool) -> None:
    """Print a result and exit with its exit code."""
    if json:
        print_json({key: value for key, value in answer.items() if key != "type"})
    elif answer["text"]:
        (people if answer["exit_code"] else page).print(answer["text"])
    if answer["exit_code"]:
        sys.exit(answer["exit_code"])
