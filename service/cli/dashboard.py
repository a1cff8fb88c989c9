"""`upright dashboard`: the page that shows a vehicle live."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from service.cli.arguments import VehicleArgument
from service.output import people


def register(app: typer.Typer) -> None:
    """Add the command of this module to `app`."""
    app.command(epilog="Example: `upright dashboard my_vehicle.toml --websocket ws://localhost:9001`")(dashboard)


def dashboard(
    vehicle: VehicleArgument = "monocab",
    websocket: Annotated[
        str, typer.Option("--websocket", help="Address of the broker's websocket listener for the browser.")
    ] = "ws://localhost:9001",
    user: Annotated[str, typer.Option("--user", help="User name at the broker; the page asks for the password.")] = "",
    password_file: Annotated[
        Path | None,
        typer.Option(
            "--password-file",
            help="File with the user's password in its first line: anyone who opens the page has this user's rights.",
        ),
    ] = None,
    data: Annotated[Path, typer.Option("--data", help="Folder of the recordings.")] = Path("recordings"),
    host: Annotated[str, typer.Option(help="Address to listen on; the page is for this machine.")] = "127.0.0.1",
    port: Annotated[int, typer.Option(help="Port to listen on.")] = 8765,
    socket: Annotated[
        Path | None,
        typer.Option(
            "--socket", help="The daemon's control socket, for the steps of the commissioning.", show_default=False
        ),
    ] = None,
) -> None:
    """Show a vehicle live in a browser: its motion, the prediction of its model, and missing effects.

    The page gets live data from the broker by websockets; this command serves recordings and diagnoses, and evaluates
    the steps of the commissioning. It works without a network. Ctrl-C ends it; the vehicle is not affected.
    """
    import uvicorn

    from service.dashboard.app import Dashboard, Settings
    from vehicles.file import load

    if not websocket.startswith(("ws://", "wss://")) or any(sign in websocket for sign in " ;,'\""):
        raise typer.BadParameter("has to be ws://HOST:PORT or wss://HOST:PORT", param_hint="--websocket")
    password = ""
    if password_file is not None:
        try:
            password = password_file.read_text(encoding="utf-8").partition("\n")[0]
        except OSError as error:
            raise typer.BadParameter(f"{password_file}: {error.strerror}", param_hint="--password-file") from error
    settings = Settings(load(vehicle), data, websocket, user, password, host, socket)
    people.print(f"Dashboard: http://{'localhost' if host in ('127.0.0.1', '0.0.0.0') else host}:{port}")
    uvicorn.run(Dashboard(settings).app, host=host, port=port, log_level="warning", access_log=False)
