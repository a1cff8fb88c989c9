"""Arguments that several commands take."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from telemetry.vehicle_modules import kinds_with

VEHICLES = f"A shipped vehicle ({', '.join(kinds_with('vehicle'))}) or a path to a vehicle file."
VehicleArgument = Annotated[str, typer.Argument(help=VEHICLES)]
RecordingsArgument = Annotated[
    list[Path],
    typer.Argument(help="Recordings: .arrow, .parquet, .csv and tables of other origin, or a raw CAN .log."),
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
VehicleOption = Annotated[str, typer.Option("--vehicle", "-v", help=VEHICLES)]
