"""The methods side by side as in the paper's figure 3: one panel per parameter, with single runs, their mean and CAD.

Small markers are single recordings with their standard deviation, the large one is their mean. The dashed line is the
reference: the true value if it is given (a virtual vehicle has one), otherwise the mean of the method to rely on. A
value outside the panel is an arrow with its number. The colours are those of Okabe and Ito, which colour-blind people
can distinguish, and the groups have markers of their own. Drawn without pyplot: no display, no global state.

Source: Griese et al., figure 3.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D

from upright.diagnosis.report.figures.drawing import Picture
from upright.estimators.contract import EstimationError
from upright.estimators.identify.table import Domain

SUFFIXES = (".png", ".svg", ".pdf")
STYLES = {
    Domain.TIME: ("#0072B2", "o"),
    Domain.FREQUENCY: ("#D55E00", "s"),
    Domain.RECURSIVE: ("#009E73", "^"),
}
"""By group: colour and marker."""
CAD_COLOUR = "0.25"
WIDEST = 0.3
"""Share of the reference on either side to which the panel extends at most to show a method's results."""
MEAN, FIRST, LAST = -0.27, -0.05, 0.35
"""Positions of the mean, and of the first and the last run, in the column of a method, which is 1 wide."""


@dataclass(frozen=True, slots=True)
class Column:
    """The results of one method for one parameter; `why` is its status if it has none."""

    name: str
    domain: Domain
    runs: Sequence[tuple[float, float]]
    mean: float | None
    why: str


def check_suffix(path: Path) -> None:
    """Raises EstimationError if the suffix of `path` is not one of SUFFIXES."""
    if path.suffix not in SUFFIXES:
        what = f"pictures are not saved as {path.suffix or 'files without a suffix'}"
        raise EstimationError(str(path), what, remedy=f"use one of {', '.join(SUFFIXES)}.")


def save_methods(document: Mapping[str, Any], path: Path, *, truth: Mapping[str, float] | None = None) -> None:
    """Write `method_figure` to `path`; its suffix (.png, .svg, .pdf) is the format."""
    check_suffix(path)
    method_figure(document, truth=truth).savefig(path, dpi=150)


def method_figure(document: Mapping[str, Any], *, truth: Mapping[str, float] | None = None) -> Picture:
    """The figure of a document of `estimators.identify.run`: a panel for each parameter that has a prior value.

    `truth`: true values by name. Raises EstimationError if no method estimates such a parameter.
    """
    truth = truth or {}
    methods = {name: entry for name, entry in document["methods"].items() if entry["domain"] != Domain.DRIVES}
    panels = [name for name in document["before"] if any(_columns(methods, name))]
    if not panels:
        raise EstimationError("picture", "there is nothing to draw", remedy="identify with a method of the vehicle.")
    figure = Picture(figsize=(max(6.0, 2.2 + 0.95 * len(methods)), 1.2 + 3.0 * len(panels)), layout="constrained")
    axes = figure.subplots(len(panels), 1, sharex=True, squeeze=False)[:, 0]
    for name, panel in zip(panels, axes, strict=True):
        columns = _columns(methods, name)
        best = next((each.mean for each in columns if each.name == document["best"]), None)
        _draw(panel, name, columns, document["before"][name], truth.get(name, best))
    columns = _columns(methods, panels[0])
    _name_groups(axes[0], columns)
    axes[-1].set_xticks(range(len(columns) + 1), ["CAD", *(_label(each) for each in columns)], fontsize=9)
    named = ["true value"] if truth.keys() & set(panels) else []
    if document["best"] and not truth.keys() >= set(panels):
        named.append(f"mean of {document['best'].replace('_', ' ')}")
    wide = figure.get_figwidth() > 9.0
    handles = _legend(", or ".join(named))
    figure.legend(handles=handles, loc="outside lower center", ncols=4 if wide else 2, frameon=False, fontsize=9)
    return figure


def _columns(methods: Mapping[str, Mapping[str, Any]], parameter: str) -> list[Column]:
    columns = []
    for name, entry in methods.items():
        found = [run["parameters"].get(parameter, {}) for run in entry["runs"]]
        runs = [(each["value"], each["std"]) for each in found if each.get("value") is not None]
        mean = entry["mean"].get(parameter, {}).get("value")
        joint = entry["parameters"].get(parameter, {})
        if mean is None and joint.get("value") is not None:
            mean = joint["value"]
        why = "" if mean is not None else joint.get("status", entry["status"])
        columns.append(Column(name, Domain(entry["domain"]), runs, mean, why))
    return columns


def _draw(axes: Axes, name: str, columns: Sequence[Column], cad: Mapping[str, Any], reference: float | None) -> None:
    middle = reference or cad["value"]
    scale, prefix = (1e-3, "k") if middle >= 1e4 else (1.0, "")
    low, high = _limits(columns, cad, middle)
    axes.errorbar(0, scale * cad["value"], scale * cad["std"], color=CAD_COLOUR, marker="D", markersize=8, capsize=4)
    for place, column in enumerate(columns, start=1):
        colour, marker = STYLES[column.domain]
        rooms = np.linspace(FIRST, LAST, 2 * len(column.runs) + 1)[1::2]
        for room, (value, std) in zip(place + rooms, column.runs, strict=True):
            if not low <= value <= high:
                _point_at(axes, float(room), value, (low, high), scale, colour, "")
                continue
            axes.errorbar(
                float(room), scale * value, scale * std, color=colour, marker=marker, markersize=4,
                elinewidth=1.0, capsize=1.5, alpha=0.55, zorder=2,
            )  # fmt: skip
        if column.mean is None:
            axes.text(
                place, scale * (low + 0.04 * (high - low)), column.why.replace("_", " "), rotation=90,
                ha="center", va="bottom", fontsize=8, color="0.45",
            )  # fmt: skip
        elif low <= column.mean <= high:
            at = place + MEAN, scale * column.mean
            axes.plot(*at, marker, color=colour, markersize=11, markeredgecolor="white", zorder=3)
        else:
            _point_at(axes, place + MEAN, column.mean, (low, high), scale, colour, f"{scale * column.mean:.4g}")
    if reference is not None:
        axes.axhline(scale * reference, color="0.2", linestyle="--", linewidth=1.0, zorder=1)
        unit = scale * middle / 100.0

        def percent(y: Any) -> Any:
            return y / unit - 100.0

        def absolute(p: Any) -> Any:
            return (p + 100.0) * unit

        share = axes.secondary_yaxis("right", functions=(percent, absolute))
        share.set_ylabel("deviation, %", fontsize=9)
        share.tick_params(labelsize=9)
    axes.set_ylim(scale * low, scale * high)
    axes.set_xlim(-0.6, len(columns) + 0.6)
    axes.set_ylabel(f"{name.replace('_', ' ')}, {prefix}{cad['unit'].replace('^2', '²')}")
    axes.tick_params(labelsize=9)
    axes.grid(axis="y", color="0.9", linewidth=0.8)
    axes.set_axisbelow(True)


def _limits(columns: Sequence[Column], cad: Mapping[str, Any], middle: float) -> tuple[float, float]:
    """The panel's range: CAD with its deviation, and all results that are not absurdly far off."""
    ends = [cad["value"] - cad["std"], cad["value"] + cad["std"], middle]
    for column in columns:
        near = [(v, s) for v, s in column.runs if abs(v - middle) < WIDEST * middle]
        ends += [end for value, std in near for end in (value - std, value + std)]
        ends += [column.mean] if column.mean is not None and abs(column.mean - middle) < WIDEST * middle else []
    ends = [end for end in ends if abs(end - middle) < WIDEST * middle] or [middle]
    margin = 0.08 * (max(ends) - min(ends)) or 0.1 * middle
    return min(ends) - margin, max(ends) + margin


def _point_at(
    axes: Axes, place: float, value: float, limits: tuple[float, float], scale: float, colour: str, text: str
) -> None:
    """An arrow at the edge of the panel towards a value that is outside of it."""
    low, high = limits
    up = value > high
    edge, inside = (high, high - 0.07 * (high - low)) if up else (low, low + 0.07 * (high - low))
    style = {"arrowstyle": "-|>", "color": colour}
    axes.annotate(
        text, (place, scale * edge), (place, scale * inside), arrowprops=style, color=colour, fontsize=8,
        ha="center", va="top" if up else "bottom",
    )  # fmt: skip


def _name_groups(axes: Axes, columns: Sequence[Column]) -> None:
    """The groups' names over the topmost panel, with lines between them in all panels."""
    for domain, (colour, _) in STYLES.items():
        places = [place for place, column in enumerate(columns, start=1) if column.domain is domain]
        if places:
            axes.text(
                0.5 * (places[0] + places[-1]), 1.02, domain.value, color=colour, ha="center", va="bottom",
                transform=axes.get_xaxis_transform(), fontsize=10, fontweight="bold",
            )  # fmt: skip
    figure = axes.figure
    assert isinstance(figure, Picture)
    for panel in figure.axes:
        for place, (column, following) in enumerate(pairwise(columns), start=1):
            if column.domain is not following.domain:
                panel.axvline(place + 0.5, color="0.8", linewidth=0.8)
        panel.axvline(0.5, color="0.8", linewidth=0.8)


def _label(column: Column) -> str:
    """The method's name without that of its group, one word per line."""
    name = column.name
    for prefix in ("frequency_", "recursive_"):
        name = name.removeprefix(prefix)
    return name.replace("_", "\n")


def _legend(reference: str) -> list[Line2D]:
    handles = [
        Line2D([], [], color=colour, marker=marker, markersize=size, linestyle="none", label=label)
        for colour, marker, size, label in (
            ("0.4", "o", 4, "one recording ± std"),
            ("0.4", "o", 10, "mean of the recordings"),
            (CAD_COLOUR, "D", 7, "CAD ± std"),
        )
    ]
    return handles + ([Line2D([], [], linestyle="--", color="0.2", label=reference)] if reference else [])
