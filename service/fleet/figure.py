"""The parameters of a vehicle over time, as a figure: each estimate with ±, the means, and the steps between them."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np
from matplotlib import dates as untyped
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from upright.diagnosis.findings import Verdict
from upright.diagnosis.report.figures.drawing import AFTER, BEFORE, WIDTH, styled, svg
from upright.diagnosis.report.names import shown
from upright.service.fleet.trends import Trend

dates: Any = untyped
COLUMNS = 2
HEIGHT = 1.35
"""Of a panel, inches."""
EXPLAINED = (Verdict.ADEQUATE, Verdict.MISSING_EFFECT)
"""Verdicts with which the model, with the effects that it lacks, explains the recording."""


@styled
def vehicle_figure(trends: Sequence[Trend], name: str) -> str:
    """Inline SVG with a panel for each of the `trends` of a vehicle; `name` distinguishes it on the page."""
    rows = -(-len(trends) // COLUMNS)
    figure = Figure(figsize=(WIDTH, HEIGHT * rows + 0.3), layout="constrained")
    panels = figure.subplots(rows, COLUMNS, squeeze=False, sharex=True).ravel()
    for axes, trend in zip(panels, trends, strict=False):
        _panel(axes, trend)
    for axes in panels[len(trends) :]:
        axes.set_visible(False)
    for axes in panels[max(0, len(trends) - COLUMNS) : len(trends)]:
        axes.tick_params(labelbottom=True)
    locator = dates.AutoDateLocator(minticks=3, maxticks=6)
    panels[0].xaxis.set_major_locator(locator)
    panels[0].xaxis.set_major_formatter(dates.ConciseDateFormatter(locator))
    return svg(figure, name, f"Parameters of {trends[0].vehicle} over time")


def _panel(axes: Axes, trend: Trend) -> None:
    factor, unit = shown(trend.unit)
    axes.margins(x=0.03)
    axes.ticklabel_format(axis="y", useOffset=False)
    times = np.array([dates.date2num(point.began) for point in trend.points])
    values, stds = factor * np.array([[point.value, point.std] for point in trend.points]).T
    explained = np.array([point.verdict in EXPLAINED for point in trend.points])
    for chosen, face in ((explained, AFTER.colour), (~explained, "white")):
        axes.errorbar(
            times[chosen], values[chosen], stds[chosen], fmt="o", markersize=3, color=AFTER.colour,
            markerfacecolor=face, linewidth=0.7,
        )  # fmt: skip
    for step in trend.steps:
        axes.axvline(0.5 * (times[step.place - 1] + times[step.place]), color="0.4", linestyle=":", linewidth=0.9)
    edges = [0, *(step.place for step in trend.steps), len(times)]
    means = [step.before for step in trend.steps] + [step.after for step in trend.steps[-1:]]
    for (begin, end), (mean, _) in zip(pairwise(edges), means, strict=False):
        axes.hlines(factor * mean, times[begin], times[end - 1], color=BEFORE.colour, linewidth=1.5, zorder=3)
    tail = "" if unit in ("", "1") else f", {unit}"
    axes.set_title(f"{trend.parameter}{tail}", loc="left", parse_math=False)
