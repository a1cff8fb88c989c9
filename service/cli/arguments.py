"""Arguments that several commands take."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Annotated

import typer

from telemetry.vehicle_modules import kinds_with


def starting(names: Iterable[str], incomplete: str) -> list[str]:
    """The names that a shell offers for an incomplete word; for none, it offers files."""
    return [name for name in names if name.startswith(incomplete)]


def vehicles(incomplete: str) -> list[str]:
    """Shipped vehicles."""
    return starting(kinds_with("vehicle"), incomplete)


def models(incomplete: str) -> list[str]:
    """Shipped models."""
    from models import library

    return starting(library.MODELS, incomplete)


def effects(incomplete: str) -> list[str]:
    """Effects of the catalogue."""
    from models.effects.catalogue import CATALOGUE

    return starting(CATALOGUE, incomplete)


def methods(incomplete: str) -> list[str]:
    """Methods of the identification."""
    from estimators.identify.table import METHODS

    return starting(METHODS, incomplete)


VEHICLES = f"A shipped vehicle ({', '.join(kinds_with('vehicle'))}) or a path to a vehicle file."
VehicleArgument = Annotated[str, typer.Argument(help=VEHICLES, autocompletion=vehicles)]
VehicleOption = Annotated[str, typer.Option("--vehicle", "-v", help=VEHICLES, autocompletion=vehicles)]
