"""A diagnosis as a page.

People look before they read: the verdict, then pictures, then the ranking in words and numbers.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from upright.diagnosis.diagnose import Diagnosis
from upright.diagnosis.lack_of_fit.adequacy import over_floor
from upright.diagnosis.prediction.compare import Comparison, compare
from upright.diagnosis.report import tables
from upright.diagnosis.report.names import file_name
from upright.diagnosis.report.page import Figures, Provenance, compared_figures, render
from upright.diagnosis.report.sentences import contradiction_sentences, disturbance_sentences, untried_sentence
from upright.diagnosis.report.words import headline
from upright.estimators.contract import EstimationError
from upright.models.model import Model
from upright.telemetry.recording import Recording

Progress = Callable[[str], None]

ALONE, BEFORE, AFTER = "fitted model", "before", "after"


def write_report(
    diagnosis: Diagnosis,
    model: Model,
    recordings: Sequence[Recording],
    *,
    support: float | None = None,
    provenance: Provenance | None = None,
    seconds: float | None = None,
    progress: Progress | None = None,
) -> str:
    """The page as text. `diagnosis` is that of `model` and `recordings`, with the same `support`. `seconds`: its time
    budget, if known.

    `progress` is called with a text that says what is being done.
    """
    report = progress or (lambda text: None)
    comparisons, why = before_and_after(diagnosis, recordings, support, report)
    report("drawing")
    return render(
        "report.html",
        [model.name],
        provenance,
        headline=headline(diagnosis),
        diagnosis=diagnosis,
        model=model,
        recordings=recordings,
        figures=_figures(diagnosis, comparisons, why),
        comparisons=comparisons,
        errors=list(tables.errors(comparisons)) if comparisons else [],
        rankings=tables.rankings(diagnosis),
        disturbance=disturbance_sentences(diagnosis),
        untried=untried_sentence(diagnosis, seconds),
        contradicted=contradiction_sentences(diagnosis),
        relevances=tables.relevances(diagnosis),
        horizon=tables.horizon(diagnosis),
        parameters=tables.parameters(diagnosis),
        remarks=tables.remarks(diagnosis),
        shaken=tables.shaken(diagnosis),
        limits=tables.limits(diagnosis),
        held=tables.held(diagnosis),
        detectables=tables.detectables(diagnosis),
        left_out=tables.left_out(diagnosis),
        used=tables.used(diagnosis, recordings),
        file_name=file_name,
    )


def before_and_after(
    diagnosis: Diagnosis,
    recordings: Sequence[Recording],
    support: float | None,
    progress: Progress = lambda text: None,
) -> tuple[list[Comparison], str]:
    """The model without and with the findings against the recordings, or why that is not possible."""
    if not diagnosis.steps:
        return [], "There is nothing to draw: no model could be fitted to these recordings."
    models = {ALONE: diagnosis.steps[0].fitted}
    if diagnosis.findings:
        models = {BEFORE: diagnosis.steps[0].fitted, AFTER: diagnosis.steps[-1].fitted}
    try:
        progress("comparing before and after")
        return compare(models, recordings, support=support, progress=progress), ""
    except EstimationError as error:
        return [], f"The models could not be run over the recordings: {error}"


def _figures(diagnosis: Diagnosis, comparisons: Sequence[Comparison], why: str) -> Figures:
    from upright.diagnosis.report.figures import diagnosis as pictures

    falling = pictures.staircase(*_stairs(diagnosis)) if diagnosis.steps else ""
    if not comparisons:
        return Figures(staircase=falling, missing=why)
    return replace(compared_figures(comparisons), staircase=falling)


def _stairs(diagnosis: Diagnosis) -> tuple[list[str], list[float]]:
    """Names and innovation energies over the floor: as given, fitted, and after each effect, all of them with the
    disturbance that the last one leaves."""
    names, ratios = [], []
    known: set[str] = set()
    first, last = diagnosis.steps[0].fit, diagnosis.steps[-1].fit
    as_given = over_floor(first, last, first.problem.kernel.vector())
    if np.isfinite(as_given):  # values with which the model diverges have no error to show
        ratios.append(as_given)
        names.append("as given")
    for place, step in enumerate(diagnosis.steps):
        # The diagnosis' own ratios are with the disturbance beside everything found, including what has no name.
        own = diagnosis.innovation_ratio_before if place == 0 else diagnosis.innovation_ratio_after
        ends = place in (0, len(diagnosis.steps) - 1)
        ratios.append(own if ends and own is not None else over_floor(step.fit, last))
        # Findings are ordered by how much they matter, steps by when they were made.
        added = [each.name for each in step.model.effects if each.name not in known]
        known.update(added)
        names.append("fitted" if place == 0 else f"with {' and '.join(added)}")
    return names, ratios
