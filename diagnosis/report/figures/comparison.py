"""Pictures of a comparison: prediction over measurement, its error by horizon, and the four views of where it fails.

Drawn without pyplot: no display, no global state. Angles in degrees; one colour per model.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from upright.diagnosis.lack_of_fit.force_bins import Binned
from upright.diagnosis.lack_of_fit.missing_force import MissingForce
from upright.diagnosis.lack_of_fit.where_it_fails import Energy
from upright.diagnosis.prediction.closed_loop_error import ClosedLoop
from upright.diagnosis.prediction.compare import Comparison
from upright.diagnosis.report.figures.drawing import Picture

Array = NDArray[np.float64]

BAND = 2.0
"""Standard deviations of a band or an error bar."""
COLUMNS = 3
LEGEND_ROOM = 0.35
FLOOR = "0.55"


def save_comparison(comparisons: Sequence[Comparison], path: Path) -> None:
    """Write `comparison_figure` to `path`; its suffix (.png, .svg, .pdf) is the format."""
    comparison_figure(comparisons).savefig(path, dpi=130)


def comparison_figure(comparisons: Sequence[Comparison]) -> Picture:
    """Overlay and errors by horizon; the closed loop if there is one; missing force by time; energies by time and
    frequency; missing force by every coordinate."""
    joints = [force.joint for force in comparisons[0].views.forces]
    places = _places(comparisons)
    loop = next((each.closed_loop for each in comparisons if each.closed_loop.measured), None)
    above = 1 if loop is None else 2
    rows = above + 1 + len(joints) + -(-len(places) // COLUMNS)
    figure = Picture(figsize=(12.5, 2.9 * rows), layout="constrained")
    grid = figure.add_gridspec(rows, 2 * COLUMNS)
    colours = mpl.color_sequences["tab10"]
    _overlay(figure.add_subplot(grid[0, :4]), comparisons, colours)
    _horizons(figure.add_subplot(grid[0, 4:]), comparisons, colours)
    if loop is not None:
        _closed_loop(figure.add_subplot(grid[1, :]), loop, comparisons, colours)
    for row, _ in enumerate(joints):
        forces = [comparison.views.forces[row] for comparison in comparisons]
        _force_by_time(figure.add_subplot(grid[above + row, :]), forces, colours)
    below = above + len(joints)
    by_time, by_frequency = figure.add_subplot(grid[below, :4]), figure.add_subplot(grid[below, 4:])
    for comparison, colour in zip(comparisons, colours, strict=False):
        _steps(by_time, comparison.views.by_time, colour, comparison.fails["time"], ("from", "to"))
        _steps(by_frequency, comparison.views.by_frequency, colour, comparison.fails["frequency"], ("from_hz", "to_hz"))
    by_time.set(xlabel="s", ylabel="innovation energy / floor", title="by time", yscale="log")
    by_frequency.set(xlabel="Hz", title="by frequency", xscale="log", yscale="log")
    for place, (joint, coordinate) in enumerate(places):
        row, column = divmod(place, COLUMNS)
        axes = figure.add_subplot(grid[below + 1 + row, 2 * column : 2 * column + 2])
        for comparison, colour in zip(comparisons, colours, strict=False):
            _by_coordinate(axes, comparison, joint, coordinate, colour)
        axes.axhline(0.0, color=FLOOR, linewidth=0.8)
        if column:
            axes.set_ylabel("")
    return figure


def _places(comparisons: Sequence[Comparison]) -> list[tuple[str, str]]:
    """Joints and coordinates of all models, each once."""
    return list(dict.fromkeys(
        (each.joint, each.coordinate.name) for comparison in comparisons for each in comparison.views.binned
    ))  # fmt: skip


def _overlay(axes: Axes, comparisons: Sequence[Comparison], colours: Sequence[object]) -> None:
    """The output that the first joint moves, or the first; measured, and as each model predicts it."""
    task = comparisons[0].innovations.problem
    names = task.kernel.outputs
    wanted = [joint.coordinate for joint in task.model.joints if joint.coordinate in names]
    channel = wanted[0] if wanted else names[0]
    output = next(each for each in task.model.outputs if each.name == channel)
    factor, unit = _shown(output.unit)
    for number, segment in enumerate(task.segments):
        label = "measured" if number == 0 else None
        axes.plot(segment.time, factor * segment.measured[:, names.index(channel)], color="0.75", lw=2.5, label=label)
    for comparison, colour in zip(comparisons, colours, strict=False):
        shown = [each for each in comparison.predictions if each.horizon <= comparison.shown_horizon]
        verdict = "adequate" if comparison.adequate else "not adequate"
        if shown and channel in shown[-1].predicted:
            last = shown[-1]
            gaps = np.where(np.diff(last.segment, prepend=last.segment[0]) != 0, np.nan, 0.0)
            fit = f"{last.horizon:g} s ahead: {last.fit_percent(channel):.1f} %"
            label = f"{comparison.name}, {fit}, {verdict}"
            axes.plot(last.time, factor * last.predicted[channel] + gaps, color=colour, lw=0.9, label=label)
        else:
            axes.plot([], [], color=colour, label=f"{comparison.name}, {verdict}")
    measured = np.concatenate([segment.measured[:, names.index(channel)] for segment in task.segments]) * factor
    # If a model diverges, the measurement has to stay in view.
    low, high = float(np.nanmin(measured)), float(np.nanmax(measured))
    reach = max(high - low, 1e-12)
    axes.set_ylim(low - 0.25 * reach, high + (0.25 + LEGEND_ROOM) * reach)
    axes.set(xlabel="s", ylabel=f"{channel}, {unit}")
    axes.legend(loc="upper right", fontsize=8, ncols=2)


def _horizons(axes: Axes, comparisons: Sequence[Comparison], colours: Sequence[object]) -> None:
    markers = "osvD^<>"
    for comparison, colour in zip(comparisons, colours, strict=False):
        for channel, marker in zip(comparison.fit_percent, markers, strict=False):
            ratios = [each.rmse(channel) / each.floor[channel] for each in comparison.predictions]
            horizons = [each.horizon for each in comparison.predictions]
            label = channel if comparison is comparisons[0] else None
            axes.plot(horizons, ratios, marker, ls="-", color=colour, ms=4, lw=0.9, label=label)
    axes.axhline(1.0, color=FLOOR, linewidth=0.8)
    axes.set(xscale="log", yscale="log", xlabel="s ahead", ylabel="error / floor")
    axes.legend(fontsize=8)


def _closed_loop(axes: Axes, loop: ClosedLoop, comparisons: Sequence[Comparison], colours: Sequence[object]) -> None:
    """The first channel of the loop, as recorded and as simulated with each model from the start of the excitation."""
    channel = next(iter(loop.measured))
    outputs = {output.name: output.unit for each in comparisons for output in each.innovations.problem.model.outputs}
    factor, unit = _shown(outputs.get(channel, ""))
    measured = factor * loop.measured[channel]
    gaps = np.where(np.diff(loop.part, prepend=loop.part[0]) != 0, np.nan, 0.0)
    axes.plot(loop.time, measured + gaps, color="0.75", lw=2.5, label="measured")
    for comparison, colour in zip(comparisons, colours, strict=False):
        each = comparison.closed_loop
        if channel in each.simulated:
            label = (
                f"{comparison.name}: {each.fit_percent(channel):.1f} %, {each.over_floor(channel):.3g} times the floor"
            )
            gaps = np.where(np.diff(each.part, prepend=each.part[0]) != 0, np.nan, 0.0)
            axes.plot(each.time, factor * each.simulated[channel] + gaps, color=colour, lw=0.9, label=label)
        else:
            axes.plot([], [], color=colour, label=f"{comparison.name}: {each.reason}")
    low, high = float(np.min(measured)), float(np.max(measured))
    reach = max(high - low, 1e-12)
    axes.set_ylim(low - 0.25 * reach, high + (0.25 + LEGEND_ROOM) * reach)
    axes.set(xlabel="s", ylabel=f"{channel}, {unit}", title="simulated in the closed loop")
    axes.legend(loc="upper right", fontsize=8, ncols=2)


def _force_by_time(axes: Axes, forces: Sequence[MissingForce], colours: Sequence[object]) -> None:
    for force, colour in zip(forces, colours, strict=False):
        for time, values in zip(force.time, force.force, strict=True):
            axes.fill_between(time, values - BAND * force.std, values + BAND * force.std, color=colour, alpha=0.2, lw=0)
            axes.plot(time, values, color=colour, lw=0.8)
    axes.axhline(0.0, color=FLOOR, linewidth=0.8)
    axes.set(xlabel="s", ylabel=f"missing force at {forces[0].joint}, {forces[0].unit}", title="by equation")


def _steps(
    axes: Axes, energies: Sequence[Energy], colour: object, fails: Sequence[dict[str, object]], ends: tuple[str, str]
) -> None:
    """A horizontal line for each part of the record, at its worst channel; bold if it fails."""
    failing = {(entry[ends[0]], entry[ends[1]]) for entry in fails}
    worst: dict[tuple[float, float], float] = {}
    for each in energies:
        worst[each.low, each.high] = max(worst.get((each.low, each.high), 0.0), each.ratio)
    lowest = min((high for _, high in worst), default=1.0)
    for (low, high), ratio in worst.items():
        # The lowest octave begins at 0 Hz, which has no place on a logarithmic axis.
        begin = 0.5 * lowest if ends[0] == "from_hz" and low == 0.0 else low
        axes.plot([begin, high], [ratio, ratio], color=colour, lw=2.8 if (low, high) in failing else 1.0)
    axes.axhline(1.0, color=FLOOR, linewidth=0.8)


def _by_coordinate(axes: Axes, comparison: Comparison, joint: str, coordinate: str, colour: object) -> None:
    """The missing force by sample, and the means by bins of what no other parameter values would explain."""
    binned = next(
        (each for each in comparison.views.binned if (each.joint, each.coordinate.name) == (joint, coordinate)), None
    )
    if binned is None:
        return
    force = next(each for each in comparison.views.forces if each.joint == joint)
    factor, unit = _shown(binned.coordinate.unit)
    rows = factor * np.concatenate(binned.coordinate.values)
    skip = max(1, len(rows) // 3000)
    axes.plot(rows[::skip], np.concatenate(force.force)[::skip], ".", color=colour, ms=1.5, alpha=0.25)
    edges, forces, deviations = _bars(binned)
    centres = 0.5 * factor * (edges[1:] + edges[:-1])
    half = 0.5 * factor * np.diff(edges)
    axes.errorbar(centres, forces, yerr=BAND * deviations, xerr=half, fmt="none", color=colour, elinewidth=1.6)
    axes.set(xlabel=f"{coordinate}, {unit}", ylabel=f"missing force at {joint}, {binned.unit}")
    axes.set_title(f"by {coordinate}", fontsize=10)
    axes.xaxis.set_major_locator(MaxNLocator(5))


def _bars(binned: Binned) -> tuple[Array, Array, Array]:
    """Edges, mean forces and standard deviations, NaN for a bin that determines no force."""
    unknown = float("nan")
    forces = [unknown if term is None else term.force for term in binned.terms]
    deviations = [unknown if term is None else term.std for term in binned.terms]
    return binned.edges, np.array(forces), np.array(deviations)


def _shown(unit: str) -> tuple[float, str]:
    """Factor and unit in which people read it."""
    if unit.startswith("rad"):
        return float(np.degrees(1.0)), unit.replace("rad", "deg", 1)
    return 1.0, unit
