"""The report of a commissioning: the document that an engineer signs and files."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any

from upright.diagnosis.report.page import Provenance, render
from upright.estimators.numbers import plain
from upright.vehicles.commissioning import Entry, Steps
from upright.vehicles.sections import VehicleFile

WORDS = {
    "accepted": "accepted",
    "not_accepted": "not accepted",
    "failed": "could not be carried out",
    "skipped": "skipped",
    "open": "not yet carried out",
    "waiting": "not yet carried out",
}


@dataclass(frozen=True, slots=True)
class Line:
    """A number with its limits, as text."""

    title: str
    value: str
    limits: str
    within: bool | None


def write_commissioning(vehicle: VehicleFile, steps: Steps, record: Sequence[Entry]) -> str:
    """The page as text: every step since the last beginning, with its numbers, files, and the hashes of these."""
    document = steps.to_json(record)
    shown = [each | {"lines": list(_lines(each)), "word": WORDS[each["state"]]} for each in document["steps"]]
    count = {word: sum(each["word"] == word for each in shown) for word in dict.fromkeys(WORDS.values())}
    hashes = {Path(path).name: digest for each in shown for path, digest in each["files"].items()}
    origin = Provenance(
        f"{vehicle.vehicle.id} (file {vehicle.configuration_hash})",
        version("upright"),
        datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC"),
        hashes,
    )
    return render(
        "commissioning.html",
        [],
        origin,
        package="upright.service.commission",
        vehicle=vehicle.vehicle,
        began=document["began"],
        complete=document["next"] is None,
        following=document["next"],
        steps=shown,
        summary=", ".join(f"{number} {word}" for word, number in count.items() if number),
        name=lambda path: Path(path).name,
    )


def _lines(step: Mapping[str, Any]) -> Sequence[Line]:
    """The numbers of a step: those with limits first."""
    judged = [
        Line(each["title"], number_text(each["value"], each["std"], each["unit"]), each["limits"], each["within"])
        for each in step["acceptance"]
    ]
    limited = {each["quantity"] for each in step["acceptance"]}
    return judged + [
        Line(name.replace("_", " "), number_text(each["value"], each["std"], each["unit"]), "", None)
        for name, each in step["numbers"].items()
        if name not in limited
    ]


def number_text(value: float | None, std: float | None, unit: str) -> str:
    """A number for people, in the unit of its limits."""
    if value is None:
        return "not known"
    scale = plain(unit)
    return f"{scale.text(value, std)} {scale.unit}".rstrip()
