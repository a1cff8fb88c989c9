"""Arguments that several commands take."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Annotated

import typer

from upright.telemetry.vehicle_modules import kinds_with


def starting(names: Iterable[str], incomplete: str) -> list[str]:
    """The names that a shell offers for an incomplete word; for none, it offers files."""
    return [name for name in names if name.startswith(incomplete)]


def vehicles(incomplete: str) -> list[str]:
    """Shipped vehicles."""
    return starting(kinds_with("vehicle"), incomplete)


def models(incomplete: str) -> list[str]:
    """Shipped models."""
    from upright.models import library

    return starting(library.MODELS, incomplete)


def effects(incomplete: str) -> list[str]:
    """Effects of the catalogue."""
    from upright.models.effects.catalogue import CATALOGUE

    return starting(CATALOGUE, incomplete)


def methods(incomplete: str) -> list[str]:
    """Methods of the identification."""
    from upright.estimators.identify.table import METHODS

    return starting(METHODS, incomplete)


VEHICLES = f"A shipped vehicle ({', '.join(kinds_with('vehicle'))}) or a path to a vehicle file."
VehicleArgument = Annotated[str, typer.Argument(help=VEHICLES, autocompletion=vehicles)]
VehicleOption = Annotated[str, typer.Option("--vehicle", "-v", help=VEHICLES, autocompletion=vehicles)]
RecordingsArgument = Annotated[
    list[Path],
    typer.Argument(help="Recordings, tables and logs of other programs, folders of a rosbag 2, or CAN logs."),
]
DiagnosedModelOption = Annotated[
    str | None,
    typer.Option(
        "--model",
        help="A model file or a shipped model.",
        show_default="the vehicle's with its CAD values",
        autocompletion=models,
    ),
]
EffectOption = Annotated[
    list[str] | None,
    typer.Option(
        "--effect",
        help="Look only for this effect: a name of the catalogue, or an effect of your own (.toml, .py). May be"
        " repeated.",
        show_default="the whole catalogue",
        autocompletion=effects,
    ),
]
AlsoOption = Annotated[
    list[str] | None,
    typer.Option("--also", help="Also look for an effect of your own (.toml, .py). May be repeated."),
]
MapOption = Annotated[
    list[str] | None,
    typer.Option(
        "--map",
        help="CHANNEL=COLUMN[:UNIT]: the column of a table that is this channel, e.g. angle=pos:deg or time=tick:ms."
        " May be repeated.",
        show_default="by their names",
    ),
]
DbcOption = Annotated[
    Path | None,
    typer.Option(
        "--dbc",
        help="A DBC file: take the signals that it names from CAN logs, in place of the vehicle's channels.",
        show_default=False,
    ),
]
AssumeOption = Annotated[
    list[str] | None,
    typer.Option(
        "--assume",
        help="CHANNEL=UNIT: what a table does not state, e.g. angle=deg, time=ms, angle=-1, voltage=12/255,"
        " angle=wrapped, angle=swapped:rate. May be repeated.",
        show_default="SI units",
    ),
]
FromOption = Annotated[
    float, typer.Option("--from", help="Use the recordings from this second on.", show_default="the beginning")
]
ToOption = Annotated[float, typer.Option("--to", help="Use the recordings up to this second.", show_default="the end")]
