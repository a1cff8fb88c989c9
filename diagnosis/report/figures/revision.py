"""A revision as a picture: the error by horizon before and after, the sensors' floor, and the parts of the error.

One panel per channel; solid lines are held-out data, dashed ones the data of the fit. The bar is the error budget of
the last horizon on held-out data (diagnosis.revise.result.Budget), as energies, so that its parts add up. Angles in
degrees. Drawn without pyplot: no display, no global state.
"""

from __future__ import annotations

from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from upright.diagnosis.report.revision_words import readable
from upright.diagnosis.revise.result import Revision

BEFORE, AFTER, FLOOR, LEFT = "#D55E00", "#0072B2", "0.75", "#E69F00"
NARROWEST = 0.06
"""Share of the bar from which on its name fits inside."""


def save_revision(revision: Revision, path: Path) -> None:
    """Write `revision_figure` to `path`; its suffix (.png, .svg, .pdf) is the format."""
    revision_figure(revision).savefig(path, dpi=130)


def revision_figure(revision: Revision) -> Figure:
    """Errors by horizon, one panel per channel, and the budget below."""
    channels = revision.units
    figure = Figure(figsize=(max(7.0, 3.6 * len(channels)), 5.2), layout="constrained")
    grid = figure.add_gridspec(2, len(channels), height_ratios=(3.2, 1.0))
    for place, (channel, unit) in enumerate(channels.items()):
        axes = figure.add_subplot(grid[0, place])
        _draw_errors(axes, revision, channel, unit)
        if place == 0:
            handles, labels = axes.get_legend_handles_labels()
            figure.legend(handles, labels, loc="outside upper center", ncols=3, fontsize=8, frameon=False)
    _draw_budget(figure.add_subplot(grid[1, :]), revision)
    return figure


def _draw_errors(axes: Axes, revision: Revision, channel: str, unit: str) -> None:
    shown, factor = readable(unit)
    sides = (
        (revision.before, BEFORE, f"without {revision.effect}"),
        (revision.after, AFTER, f"with {revision.effect}"),
    )
    floor = [factor * each for each in revision.floor_held_out[channel]]
    lowest = 0.5 * min(*floor, *(factor * e for side, _, _ in sides for e in side.held_out[channel]))
    axes.fill_between(revision.horizons, floor, lowest, color=FLOOR, linewidth=0.0, label="sensors alone")
    for side, colour, label in sides:
        held_out, training = ([factor * each for each in kind[channel]] for kind in (side.held_out, side.training))
        axes.plot(revision.horizons, held_out, "o-", color=colour, label=f"{label}, held out")
        axes.plot(revision.horizons, training, "--", color=colour, linewidth=0.9, label=f"{label}, fitted")
    axes.set(xscale="log", yscale="log", xlabel="s ahead", ylabel=f"RMS error of {channel}, {shown}")
    axes.set_xticks(revision.horizons, [f"{each:g}" for each in revision.horizons])
    axes.minorticks_off()
    axes.set_ylim(bottom=lowest)


def _draw_budget(axes: Axes, revision: Revision) -> None:
    budget, start = revision.budget, 0.0
    parts = (
        ("sensors", budget.sensors, FLOOR),
        (revision.effect, budget.effect, AFTER),
        ("unexplained", budget.unexplained, LEFT),
    )
    for name, share, colour in parts:
        text = f"{name} {100.0 * share:.1f} %"
        axes.barh(0.0, share, left=start, color=colour, height=0.8, label=text)
        if share > NARROWEST * (1.0 + 0.5 * len(text) / 10.0):
            shade = "white" if colour == AFTER else "black"
            axes.text(start + 0.5 * share, 0.0, text, ha="center", va="center", color=shade, fontsize=9)
        start += share
    axes.set(xlim=(0.0, 1.0), yticks=(), xticks=())
    axes.set_xlabel(f"held-out error energy {revision.horizons[-1]:g} s ahead, before {revision.effect} was added")
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, 1.5), ncols=3, fontsize=8, frameon=False)
