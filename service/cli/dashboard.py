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
        str, typer.Option("--websocket", help="The broker's websocket listener, as a browser reaches it.")
    ] = "ws://localhost:9001",
    user: Annotated[str, typer.Option("--user", help="At the broker; the page asks for a password.")] = "",
    password_file: Annotated[
        Path | None,
        typer.Option(
            "--password-file",
            help="File with the user's password in its first line: whoever reaches the page may do what this user may.",
        ),
    ] = None,
    data: Annotated[Path, typer.Option("--data", help="Folder of the recordings.")] = Path("recordings"),
    host: Annotated[str, typer.Option(help="Address to listen at; the page is for this machine.")] = "127.0.0.1",
    port: Annotated[int, typer.Option(help="Port to listen at.")] = 8765,
) -> None:
    """Show a vehicle live in a browser: what it does, what the model says, what is missing.

    The page takes what is live from the broker, by websockets; recordings and diagnoses come from this command. It
    works without a network. Ctrl-C ends it; the vehicle does not mind.
    """
    import uvicorn

    from service.dashboard.app import Dashboard, Settings
    from vehicles.file import load

    if not websocket.startswith(("ws://", "wss://")) or any(sign in websocket for sign in " ;,'\""):
        raise typer.BadParameter("is ws://HOST:PORT or wss://HOST:PORT", param_hint="--websocket")
    password = ""
    if password_file is not None:
        try:
            password = password_file.read_text(encoding="utf-8").partition("\n")[0]
        except OSError as error:
            raise typer.BadParameter(f"{password_file}: {error.strerror}", param_hint="--password-file") from error
    settings = Settings(load(vehicle), data, websocket, user, password, host)
    people.print(f"Dashboard: http://{'localhost' if host in ('127.0.0.1', '0.0.0.0') else host}:{port}")
    uvicorn.run(Dashboard(settings).app, host=host, port=port, log_level="warning", access_log=False)
