"""An identification as a page: what to rely on, the methods side by side, and what the estimates predict."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from upright.diagnosis.prediction.compare import Comparison
from upright.diagnosis.report.comparison_report import Compared
from upright.diagnosis.report.names import file_name
from upright.diagnosis.report.page import Provenance, compared_figures, render
from upright.estimators.contract import EstimationError
from upright.estimators.identify.document import CANCELLED
from upright.estimators.identify.rows import (
    Columns,
    disturbances,
    joint_columns,
    mean_columns,
    others,
    remarks,
    scale_of,
    sentence,
    shown_parameters,
    value_text,
)
from upright.estimators.identify.table import Domain

WIDE, LOW = 10.0, 0.75
"""Least width of the figure, in inches, and the factor by which its height is reduced."""


@dataclass(frozen=True, slots=True)
class MethodTable:
    """A table of the page: headings with units, rows of text; a row that is one text names a group."""

    title: str
    headings: Sequence[tuple[str, str]]
    rows: Sequence[Sequence[str]]


def write_identification(
    document: Mapping[str, Any],
    model: str,
    *,
    truth: Mapping[str, float] | None = None,
    comparisons: Sequence[Comparison] = (),
    why: str = "",
    provenance: Provenance | None = None,
    progress: Callable[[str], None] | None = None,
) -> str:
    """The page as text, of a `document` of `estimators.identify.run` for the model of this name.

    `truth` has true values by name. `comparisons` are of the model before and with the estimates to rely on, against
    the recordings; if there are none, `why` says why.
    """
    if progress is not None:
        progress("drawing")
    begun = {name: entry for name, entry in document["methods"].items() if entry["status"] != CANCELLED}
    recordings = [each["recording"] for each in document["recordings"]]
    part = Compared("", comparisons, compared_figures(comparisons)) if comparisons else None
    return render(
        "identify.html",
        [model],
        provenance,
        model=model,
        recordings=recordings,
        best=document["best"],
        best_reason=sentence(document["best_reason"]),
        others=list(others(begun)),
        fit_note=_fit_note(document),
        estimates=list(_estimates(document)),
        disturbances=list(disturbances(document)),
        figure=_figure(document, truth or {}),
        tables=list(_tables(document, begun, truth or {})),
        drives=[
            (name, value_text(found, scale), scale.unit)
            for entry in begun.values()
            if entry["domain"] == Domain.DRIVES
            for name, found in entry["parameters"].items()
            if (scale := scale_of([found], found["unit"]))
        ],
        remarks=list(remarks(document["methods"])),
        part=part,
        why=why,
        file_name=file_name,
    )


def _fit_note(document: Mapping[str, Any]) -> str:
    """What the column of the fit means."""
    if not document["fit_measured_alike"]:
        return "Own fit: each method's own measure for the channel that it explains worst; these cannot be compared."
    return f"Fit: of the prediction {document['fit_horizon']:.2g} s ahead, for the channel that is predicted worst."


def _estimates(document: Mapping[str, Any]) -> list[tuple[str, str, str, str]]:
    """Name, value, unit and the value before of each parameter, by the method to rely on."""
    if not document["best"]:
        return []
    found = document["methods"][document["best"]]["parameters"]
    rows = []
    for name, unit in shown_parameters({"": {"parameters": found}}).items():
        before = document["before"].get(name)
        scale = scale_of([found[name], before], unit)
        rows.append((name, value_text(found[name], scale), scale.unit, value_text(before, scale)))
    return rows


def _figure(document: Mapping[str, Any], truth: Mapping[str, float]) -> str:
    """The methods side by side, "" if no method estimates a parameter that has a prior value."""
    from upright.diagnosis.report.figures.drawing import styled, svg
    from upright.diagnosis.report.figures.methods import method_figure

    @styled
    def drawn() -> str:
        figure = method_figure(document, truth=truth)
        # Wider than high, also for few methods, so that it fits below the estimates on paper.
        figure.set_size_inches(max(WIDE, figure.get_figwidth()), LOW * figure.get_figheight())
        return svg(figure, "methods", "Parameters by method, each run and their mean")

    try:
        return drawn()
    except EstimationError:
        return ""


def _tables(
    document: Mapping[str, Any], begun: Mapping[str, Mapping[str, Any]], truth: Mapping[str, float]
) -> list[MethodTable]:
    methods = {name: entry for name, entry in begun.items() if entry["domain"] != Domain.DRIVES}
    if not methods:
        return []
    several = len(document["recordings"]) > 1
    title = "All recordings together" if several else "The recording"
    tables = [_table(title, joint_columns(methods, document, truth))]
    if any(mean["runs"] > 1 for entry in methods.values() for mean in entry["mean"].values()):
        tables.append(_table("Mean of the single recordings, ± their scatter", mean_columns(methods, document)))
    return tables


def _table(title: str, groups: Sequence[Columns]) -> MethodTable:
    columns = [column for group in groups for column in group]
    rows = list(zip(*(column[2:] for column in columns), strict=True))
    return MethodTable(
        title,
        [(column[0], column[1]) for column in columns],
        [[row[0].strip("[]")] if row[0].startswith("[") else row for row in rows],
    )
