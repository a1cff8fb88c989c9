"""Arguments that several commands take."""

from __future__ import annotations

from typing import Annotated

import typer

from telemetry.vehicle_modules import kinds_with

VEHICLES = f"A shipped vehicle ({', '.join(kinds_with('vehicle'))}) or a path to a vehicle file."
VehicleArgument = Annotated[str, typer.Argument(help=VEHICLES)]
VehicleOption = Annotated[str, typer.Option("--vehicle", "-v", help=VEHICLES)]
