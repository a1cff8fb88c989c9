"""The parameters of each vehicle over its recordings, and what has changed. Pure."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from datetime import datetime
from math import hypot, isfinite
from typing import Any

from upright.diagnosis.report.names import shown
from upright.estimators.numbers import with_error
from upright.estimators.steps import SHORTEST, Step, steps
from upright.service.fleet.results import Row

LEVEL = 0.01
"""Probability with which the report of a fleet in which nothing changes names a change."""
LEAST = 1e-3
"""p-values below are not distinguished."""
APART = 2.0
"""Standard deviations from zero from which on the ratio of two values means something."""


@dataclass(frozen=True, slots=True)
class Point:
    """An estimate from the recording that `began` then, with the `std` by which recordings are compared."""

    began: datetime
    value: float
    std: float
    verdict: str
    recording: str


@dataclass(frozen=True, slots=True)
class Trend:
    """A `parameter` of a `vehicle`, in `unit`, over its recordings in the order of time, and the steps in it."""

    vehicle: str
    parameter: str
    unit: str
    points: tuple[Point, ...]
    steps: tuple[Step, ...]

    def since(self, step: Step) -> datetime:
        """When the first recording after `step` began."""
        return self.points[step.place].began

    def change(self, step: Step) -> str:
        """A step as a sentence."""
        factor, unit = shown(self.unit)
        before, after = ((factor * value, factor * std) for value, std in (step.before, step.after))
        return (
            f"Since {self.since(step):%Y-%m-%d}, {self.parameter} of {self.vehicle} {_how(before, after)}:"
            f" {with_error(*after, unit)} after {with_error(*before, unit)}, {p_text(step.p_value)}"
        )

    def to_json(self, step: Step) -> dict[str, Any]:
        """A step as JSON-ready values."""
        before, after = ({"value": value, "std": std} for value, std in (step.before, step.after))
        return {
            "vehicle": self.vehicle,
            "parameter": self.parameter,
            "unit": self.unit,
            "since": self.since(step).isoformat(),
            "recording": self.points[step.place].recording,
            "before": before,
            "after": after,
            "p_value": step.p_value,
            "text": self.change(step),
        }


def trends(rows: Iterable[Row]) -> tuple[Trend, ...]:
    """All trends, by vehicle and parameter; p-values are corrected for all of them that can be tested.

    A recording without a time is left out.
    """
    series: dict[tuple[str, str, str], list[Point]] = {}
    for row in rows:
        for each in row.parameters:
            if row.began is None or each.value is None or not each.own_std or not isfinite(each.own_std):
                continue
            point = Point(row.began, each.value, each.own_std, row.verdict or "", row.recording)
            series.setdefault((row.vehicle, each.name, each.unit), []).append(point)
    tests = max(1, sum(len(points) >= SHORTEST for points in series.values()))
    return tuple(_trend(*key, points, tests) for key, points in sorted(series.items()))


def changes(found: Sequence[Trend]) -> list[tuple[Trend, Step]]:
    """All steps, the least p-value first."""
    return sorted(((trend, step) for trend in found for step in trend.steps), key=lambda each: each[1].p_value)


def _trend(vehicle: str, parameter: str, unit: str, points: list[Point], tests: int) -> Trend:
    ordered = tuple(sorted(points, key=lambda point: (point.began, point.recording)))
    values, stds = [point.value for point in ordered], [point.std for point in ordered]
    return Trend(vehicle, parameter, unit, ordered, steps(values, stds, level=LEVEL, tests=tests))


def _how(before: tuple[float, float], after: tuple[float, float]) -> str:
    """By which factor a value changed, if both are away from zero on the same side."""
    (old, old_std), (new, new_std) = before, after
    if old * new > 0.0 and abs(old) > APART * old_std and abs(new) > APART * new_std:
        ratio = new / old
        return f"is {with_error(ratio, ratio * hypot(old_std / old, new_std / new))} times what it was before"
    return "has increased" if new > old else "has decreased"


def p_text(p_value: float) -> str:
    """`p = 0.004`, or `p < 0.001`."""
    return f"p < {LEAST:g}" if p_value < LEAST else f"p = {p_value:.1g}"
