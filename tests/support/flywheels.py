"""A MONOCAB whose flywheels report their speed: the shipped vehicle with the sections that are there as comments."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from upright.vehicles.file import VehicleFile, load

MARK = "#:"


def with_flywheels(folder: Path, change: Callable[[str], str] = lambda text: text) -> VehicleFile:
    """The vehicle, from a file in `folder`, whose text `change` may have changed. Raises VehicleFileError."""
    lines = Path(load("monocab").path).read_text("utf-8").splitlines()
    text = "\n".join(line.removeprefix(MARK).lstrip() if line.startswith(MARK) else line for line in lines)
    path = folder / "vehicle.toml"
    path.write_text(change(text), "utf-8")
    return load(path)
