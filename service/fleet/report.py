"""A fleet as a page: what has changed, the vehicles with their trends, and the recordings that could not be used."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib.metadata import version

from upright.diagnosis.report.page import Provenance, render
from upright.diagnosis.report.tables import HARD_SPACE
from upright.estimators.steps import SHORTEST
from upright.service.fleet.results import Row
from upright.service.fleet.run import Fleet
from upright.service.fleet.trends import LEVEL, Trend, changes

DRAWN = 50
"""Vehicles with figures at most; those with changes come first."""
WORDS = {
    "adequate": "adequate",
    "missing_effect": "lacking an effect",
    "unknown": "not explained",
    "insufficient_data": "insufficient",
    None: "not read",
}


@dataclass(frozen=True, slots=True)
class Vehicle:
    """A vehicle of the page: its recordings by verdict and the effects found, as text, what changed, and its figure."""

    name: str
    recordings: int
    verdicts: str
    effects: str
    changes: tuple[str, ...]
    figure: str


def write_fleet(fleet: Fleet, trends: Sequence[Trend], url: str) -> str:
    """The page as text, of the recordings at `url` and their `trends`."""
    names = sorted({row.vehicle for row in fleet.rows}, key=lambda name: (not _changed(trends, name), name))
    vehicles = [_vehicle(name, fleet.rows, trends, number < DRAWN) for number, name in enumerate(names)]
    return render(
        "fleet.html",
        sorted({row.model for row in fleet.rows}),
        Provenance(version=version("upright"), date=f"{datetime.now(UTC):%Y-%m-%d %H:%M} UTC"),
        package="upright.service.fleet",
        url=url,
        summary=summary(fleet),
        changes=_sentences(trends),
        vehicles=vehicles,
        drawn=DRAWN,
        failures=fleet.failures,
        missing=fleet.missing,
        tested=sum(len(trend.points) >= SHORTEST for trend in trends),
        shortest=SHORTEST,
        percent=f"{100.0 * LEVEL:g}",
        by_file=sum(row.began_by == "file" for row in fleet.rows),
    )


def summary(fleet: Fleet) -> str:
    """How many recordings of how many vehicles, by verdict."""
    vehicles = len({row.vehicle for row in fleet.rows})
    return f"{_count(len(fleet.rows), 'recording')} of {_count(vehicles, 'vehicle')}: {_verdicts(fleet.rows)}"


def _vehicle(name: str, rows: Iterable[Row], trends: Sequence[Trend], drawn: bool) -> Vehicle:
    from upright.service.fleet.figure import vehicle_figure

    own = [row for row in rows if row.vehicle == name]
    shown = [trend for trend in trends if trend.vehicle == name and len(trend.points) > 1]
    effects = Counter(effect.name for row in own for effect in row.effects if not effect.negligible)
    return Vehicle(
        name=name or "(no name)",
        recordings=len(own),
        verdicts=_verdicts(own),
        effects=", ".join(f"{effect} ({number})" for effect, number in effects.most_common()),
        changes=_sentences(shown),
        figure=vehicle_figure(shown, f"vehicle-{name}") if shown and drawn else "",
    )


def _sentences(trends: Sequence[Trend]) -> tuple[str, ...]:
    return tuple(trend.change(step).replace(" ± ", f"{HARD_SPACE}±{HARD_SPACE}") for trend, step in changes(trends))


def _changed(trends: Sequence[Trend], name: str) -> bool:
    return any(trend.steps for trend in trends if trend.vehicle == name)


def _verdicts(rows: Sequence[Row]) -> str:
    count = Counter(row.verdict for row in rows)
    return ", ".join(f"{count[verdict]} {word}" for verdict, word in WORDS.items() if count[verdict])


def _count(number: int, what: str) -> str:
    return f"{number:,} {what}{'' if number == 1 else 's'}"
