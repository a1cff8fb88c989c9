"""The record of a commissioning, kept by the daemon: one file in the data folder, oldest entry first.

It survives a restart and a change of the client, so that a commissioning can be continued after a day and on another
screen. Nothing is ever removed from it.
"""

from __future__ import annotations

from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from upright.service.control import kept
from upright.telemetry.errors import UprightError
from upright.vehicles.commissioning import CommissioningError, Entry, Steps, steps_for
from upright.vehicles.sections import VehicleFile

FILE = "commissioning.json"


class RecordError(UprightError):
    """The record of a commissioning cannot be read or written."""


@dataclass(frozen=True, slots=True)
class Record:
    """The `entries` of the commissionings of one vehicle, with its `steps`; None if its kind has none."""

    steps: Steps | None
    entries: tuple[Entry, ...] = ()

    @classmethod
    def read(cls, folder: Path, vehicle: VehicleFile) -> Record:
        """The record of `vehicle` in `folder`, empty if there is none. Raises RecordError."""
        try:
            steps = steps_for(vehicle)
        except CommissioningError:
            steps = None
        path = folder / FILE
        try:
            entries = tuple(Entry.model_validate(each) for each in kept.read(path))
        except (OSError, ValueError, TypeError, ValidationError) as error:
            raise RecordError(
                f"{path} cannot be read ({error}).", remedy="Move it away: the commissioning then starts from nothing."
            ) from error
        return cls(steps, entries)

    def with_next(self, entry: Entry) -> Record:
        """With `entry` added, dated now. Raises CommissioningError if there is no such step."""
        if self.steps is not None and entry.step:
            self.steps.find(entry.step)
        dated = entry.model_copy(update={"date": datetime.now(UTC).strftime("%Y-%m-%d %H:%M:%S")})
        return Record(self.steps, (*self.entries, dated))

    def write(self, folder: Path) -> None:
        """Replace the file in `folder` at once. Raises RecordError if it cannot be written."""
        path = folder / FILE
        try:
            kept.replace(path, [each.model_dump(mode="json") for each in self.entries])
        except OSError as error:
            raise RecordError(
                f"{path} cannot be written ({error.strerror}): the step is not in the record.",
                remedy="Make room there, or give a writable folder with --data.",
            ) from error

    def to_json(self) -> dict[str, Any] | None:
        """The topic `commissioning`; None for a kind of vehicle without steps."""
        return self.steps.to_json(self.entries) if self.steps is not None else None
