"""`upright dashboard`: the page that shows a vehicle live."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated

import typer

from upright.service.cli.arguments import VehicleArgument
from upright.service.output import people

SHORTEST_TOKEN = 16
"""Characters of a token, which then cannot be guessed."""


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
            help="File with the user's password in its first line; pages with the token get it.",
        ),
    ] = None,
    token_file: Annotated[
        Path | None,
        typer.Option(
            "--token-file",
            help="File with the token of the page's address in its first line; made if it is missing.",
            show_default="a new token, in the address that is printed",
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

    from upright.service.dashboard.app import Dashboard, Settings
    from upright.service.dashboard.guard import LIMITS, new_token
    from upright.vehicles.file import load

    if not websocket.startswith(("ws://", "wss://")) or any(sign in websocket for sign in " ;,'\""):
        raise typer.BadParameter("has to be ws://HOST:PORT or wss://HOST:PORT", param_hint="--websocket")
    password = "" if password_file is None else _first_line(password_file, "--password-file")
    token = new_token()
    if token_file is not None:
        if not token_file.exists():
            _write_secret(token_file, token, "--token-file")
        token = _first_line(token_file, "--token-file")
        if len(token) < SHORTEST_TOKEN:
            text = f"{token_file}: a token has at least {SHORTEST_TOKEN} characters; remove the file to have one made"
            raise typer.BadParameter(text, param_hint="--token-file")
    settings = Settings(load(vehicle), data, websocket, user, password, host, socket, token)
    address = f"http://{'localhost' if host in ('127.0.0.1', '0.0.0.0') else host}:{port}/"
    shown = token if token_file is None else f"$(cat {token_file})"
    people.print(f"Dashboard: {address}#token={shown}", soft_wrap=True)
    uvicorn.run(Dashboard(settings).app, host=host, port=port, **LIMITS)


def _first_line(path: Path, option: str) -> str:
    try:
        return path.read_text(encoding="utf-8").partition("\n")[0]
    except OSError as error:
        raise typer.BadParameter(f"{path}: {error.strerror}", param_hint=option) from error


def _write_secret(path: Path, secret: str, option: str) -> None:
    """Write a new file that only its owner can read."""
    try:
        with os.fdopen(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "w", encoding="utf-8") as file:
            file.write(secret + "\n")
    except OSError as error:
        raise typer.BadParameter(f"{path}: {error.strerror}", param_hint=option) from error
