"""The parameters that the controllers are designed for: those of the vehicle file, until somebody adopts others.

A result acts only after `upright design RESULT --use`. What was adopted is kept in one file in the data folder, oldest
first, so that it survives a restart and nothing of it is lost: going back is an entry, too.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from upright.service.control import kept
from upright.telemetry.errors import UprightError
from upright.vehicles.sections import VehicleFile

FILE = "controller.json"


class AdoptedError(UprightError):
    """The file of adopted parameters cannot be read, or its parameters cannot be used."""


class Adopted(BaseModel):
    """Parameters from `source`, a file of estimates or a model, and its SHA-256; none of both: the vehicle file's."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    source: str = ""
    sha256: str = ""
    values: dict[str, float] = Field(default_factory=dict)
    """SI."""
    deviations: dict[str, float] = Field(default_factory=dict)
    date: str = ""
    """UTC, when it was adopted."""

    @property
    def text(self) -> str:
        """Where the parameters come from, in words."""
        return f"{self.source}, adopted on {self.date}" if self.source else "the vehicle file"

    def of(self, vehicle: VehicleFile) -> VehicleFile:
        """`vehicle` with these parameters. Raises AdoptedError if one of them is impossible."""
        unknown = [name for name in self.values if name not in vehicle.parameters.values]
        if unknown:
            there = ", ".join(vehicle.parameters.values)
            raise AdoptedError(f"there is no parameter {unknown[0]}.", remedy=f"Use some of: {there}.")
        try:
            return vehicle.with_values(self.values, self.deviations)
        except ValueError as error:
            raise AdoptedError(f"{self.source}: {error}", remedy="Identify the vehicle again.") from error


VEHICLE_FILE = Adopted()


@dataclass(frozen=True, slots=True)
class History:
    """All that was adopted, oldest first, the last one acting. It begins with the vehicle file."""

    entries: tuple[Adopted, ...] = (VEHICLE_FILE,)

    @property
    def acting(self) -> Adopted:
        return self.entries[-1]

    @property
    def before(self) -> Adopted | None:
        """What acted before the one that is acting, None if nothing did."""
        return self.entries[-2] if len(self.entries) > 1 else None

    def with_next(self, adopted: Adopted) -> History:
        return History((*self.entries, adopted))

    @classmethod
    def read(cls, folder: Path) -> History:
        """The history in `folder`; the beginning of one if there is none. Raises AdoptedError."""
        path = folder / FILE
        try:
            entries = tuple(Adopted.model_validate(each) for each in kept.read(path))
        except (OSError, ValueError, TypeError, ValidationError) as error:
            raise AdoptedError(
                f"{path} cannot be read ({error}).",
                remedy="Move it away: the controllers are then designed for the vehicle file's parameters.",
            ) from error
        return cls(entries or (VEHICLE_FILE,))

    def write(self, folder: Path) -> None:
        """Replace the file in `folder` at once. Raises AdoptedError if it cannot be written."""
        path = folder / FILE
        try:
            kept.replace(path, [each.model_dump() for each in self.entries])
        except OSError as error:
            what = f"{path} cannot be written ({error.strerror}): nothing has changed."
            raise AdoptedError(what, remedy="Make room there, or give a writable folder with --data.") from error

    def to_json(self) -> dict[str, Any]:
        """`design` in the daemon's status."""
        acting = self.acting
        return {"source": acting.source, "date": acting.date, "text": acting.text, "values": dict(acting.values)}
