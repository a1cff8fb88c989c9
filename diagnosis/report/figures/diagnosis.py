"""The report's figures: prediction over measurement, where the model fails, the missing force, the error by step."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.legend_handler import HandlerTuple
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import FuncFormatter, MaxNLocator, NullFormatter
from numpy.typing import NDArray

from upright.diagnosis.lack_of_fit.force_bins import Binned
from upright.diagnosis.lack_of_fit.where_it_fails import Energy
from upright.diagnosis.prediction.compare import Comparison
from upright.diagnosis.prediction.horizons import Prediction
from upright.diagnosis.report.figures.drawing import (
    FLOOR,
    MEASURED,
    WIDTH,
    Look,
    in_a_row,
    looks,
    separate,
    styled,
    svg,
    thinned,
)
from upright.diagnosis.report.names import file_name, shown

Array = NDArray[np.float64]

BAND = 2.0
"""Standard deviations of a band."""
COLUMNS = 3
MOST_PANELS = 9
"""Coordinates by which the missing force is shown: those that explain most of it."""
MOST_IN_ONE_LINE = 4
"""Steps whose names fit beside each other."""
IN_A_ROW = "s, the recordings one after the other"
HIGHEST = 99.5
"""Percentile of the errors that the figure shows: if a model diverges, the others stay in view."""


@styled
def overlay(comparisons: Sequence[Comparison], name: str = "overlay") -> str:
    """Every channel: measured, predicted by each model, and below it the errors with the band due to noise."""
    ahead = [_shown(each) for each in comparisons]
    task = comparisons[0].innovations.problem
    channels = [output for output in task.model.outputs if output.name in task.kernel.outputs]
    ratios = [share for _ in channels for share in (1.5, 1.0)]
    figure = Figure(figsize=(WIDTH, 0.45 + 2.5 * len(channels)), layout="constrained")
    panels = figure.subplots(2 * len(channels), 1, sharex=True, height_ratios=ratios, squeeze=False)[:, 0]
    shifts = in_a_row(*_ends(comparisons[0]))
    sources = [file_name(segment.source) for segment in task.segments]
    begins = [segment.time[0] + shift for segment, shift in zip(task.segments, shifts, strict=True)]
    firsts = [place for place, shift in enumerate(shifts) if place == 0 or shift != shifts[place - 1]]
    for output, upper, lower in zip(channels, panels[::2], panels[1::2], strict=True):
        factor, unit = shown(output.unit)
        place = task.kernel.outputs.index(output.name)
        for number, (segment, shift) in enumerate(zip(task.segments, shifts, strict=True)):
            time, values = thinned(segment.time + shift, factor * segment.measured[:, place])
            upper.plot(time, values, color=MEASURED, linewidth=2.2, label=None if number else "measured")
        for comparison, each, look in zip(comparisons, ahead, looks(len(comparisons)), strict=True):
            if each is not None:
                _predicted(upper, lower, each, output.name, factor, shifts, look, comparison.name)
        _limits(upper, lower, [each for each in ahead if each is not None], output.name, factor)
        upper.set_ylabel(f"{output.name}, {unit}")
        lower.set_ylabel(f"error, {unit}")
        separate(upper, [begins[each] for each in firsts], [sources[each] for each in firsts])
    panels[-1].set_xlabel("s" if len(firsts) < 2 else IN_A_ROW)
    handles, labels = panels[0].get_legend_handles_labels()
    handles.append(Patch(color="0.88"))
    labels.append(f"noise and disturbance alone (±{BAND:g} std)")
    figure.legend(handles, labels, loc="outside upper left", ncols=4)
    return svg(figure, name, "Measured and predicted, by channel, and the prediction errors")


def _shown(comparison: Comparison) -> Prediction | None:
    longest = comparison.shown_horizon
    return next((each for each in reversed(comparison.predictions) if each.horizon <= longest), None)


def _ends(comparison: Comparison) -> tuple[list[float], list[float]]:
    segments = comparison.innovations.problem.segments
    return [float(each.time[0]) for each in segments], [float(each.time[-1]) for each in segments]


def _predicted(
    upper: Axes, lower: Axes, ahead: Prediction, channel: str, factor: float, shifts: Array, look: Look, name: str
) -> None:
    gaps = np.where(np.diff(ahead.segment, prepend=ahead.segment[0]) != 0, np.nan, 0.0)
    time = ahead.time + shifts[ahead.segment]
    predicted = factor * ahead.predicted[channel] + gaps
    error = factor * (ahead.measured[channel] - ahead.predicted[channel]) + gaps
    time, predicted, error = thinned(time, predicted, error)
    upper.plot(time, predicted, **look.line, label=f"{name}, {ahead.horizon:g} s ahead")
    lower.plot(time, error, **look.line)


def _limits(upper: Axes, lower: Axes, ahead: Sequence[Prediction], channel: str, factor: float) -> None:
    """Set the limits so that the measurement stays in view if a model diverges."""
    if not ahead:
        return
    measured = factor * ahead[-1].measured[channel]
    low, high = float(np.nanmin(measured)), float(np.nanmax(measured))
    reach = max(high - low, 1e-12)
    upper.set_ylim(low - 0.25 * reach, high + 0.25 * reach)
    floor = BAND * factor * ahead[-1].floor[channel]
    lower.axhspan(-floor, floor, color="0.88", linewidth=0.0, zorder=0)
    errors = [np.abs(factor * (each.measured[channel] - each.predicted[channel])) for each in ahead]
    most = max(1.5 * floor, *(float(np.nanpercentile(each, HIGHEST)) for each in errors))
    lower.set_ylim(-1.1 * most, 1.1 * most)


@styled
def energies(comparisons: Sequence[Comparison], name: str = "energies") -> str:
    """Innovation energy over the floor, by time and by frequency, with a marker where noise does not explain it."""
    figure = Figure(figsize=(WIDTH, 2.5), layout="constrained")
    by_time, by_frequency = figure.subplots(1, 2, width_ratios=(1.7, 1.0), sharey=True)
    for comparison, look in zip(comparisons, looks(len(comparisons)), strict=True):
        views, fails = comparison.views, comparison.fails
        in_time = {(e["channel"], e["recording"], e["from"]) for e in fails["time"]}
        in_frequency = {e["from_hz"] for e in fails["frequency"]}
        _levels(by_time, _by_time(views.by_time, in_time), look, comparison.name)
        _levels(by_frequency, _by_frequency(views.by_frequency, in_frequency), look, comparison.name)
    for axes in (by_time, by_frequency):
        axes.axhline(1.0, color=FLOOR, linewidth=1.4)
        axes.set_yscale("log")
        low, high = axes.get_ylim()
        axes.set_ylim(min(low, 0.5), max(high, 11.0))
        axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        axes.yaxis.set_minor_formatter(NullFormatter())
    several = len({segment.source for segment in comparisons[0].innovations.problem.segments}) > 1
    by_frequency.set(xscale="log", xlabel="Hz", title="by frequency")
    by_frequency.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    by_time.set(xlabel=IN_A_ROW if several else "s", ylabel="innovation energy\nrelative to noise", title="by time")
    handles, labels = by_time.get_legend_handles_labels()
    markers = tuple(Line2D([], [], **look.points, markersize=4) for look in looks(len(comparisons)))
    handles += [markers, Line2D([], [], color=FLOOR, linewidth=1.4)]
    labels += ["more than noise explains", "noise alone"]
    both = {tuple: HandlerTuple(ndivide=None)}
    figure.legend(handles, labels, loc="outside upper left", ncols=4, handler_map=both)
    return svg(figure, name, "Innovation energy relative to noise, by time and by frequency")


Level = tuple[float, float, float, bool]
"""From, to, energy over the floor, whether it is beyond noise."""


def _by_time(parts: Sequence[Energy], fails: set[tuple[str, str, float]]) -> list[Level]:
    """The worst channel of each window."""
    by_channel: dict[str, list[Energy]] = {}
    for each in parts:
        by_channel.setdefault(each.channel, []).append(each)
    windows = list(zip(*by_channel.values(), strict=True))
    shifts = in_a_row([window[0].low for window in windows], [window[0].high for window in windows])
    return [
        (
            window[0].low + shift,
            window[0].high + shift,
            max(each.ratio for each in window),
            any((each.channel, each.recording, each.low) in fails for each in window),
        )
        for window, shift in zip(windows, shifts.tolist(), strict=True)
    ]


def _by_frequency(parts: Sequence[Energy], fails: set[float]) -> list[Level]:
    """The worst channel of each octave. The lowest begins at 0 Hz, which has no place on a logarithmic axis."""
    worst: dict[float, Energy] = {}
    for each in parts:
        if each.low not in worst or each.ratio > worst[each.low].ratio:
            worst[each.low] = each
    return [(each.low or 0.5 * each.high, each.high, each.ratio, low in fails) for low, each in sorted(worst.items())]


def _levels(axes: Axes, levels: Sequence[Level], look: Look, name: str) -> None:
    if not levels:
        return
    edges = [each for low, high, *_ in levels for each in (low, high)]
    ratios = [ratio for *_, ratio, _ in levels for _ in range(2)]
    axes.plot(edges, ratios, **look.line, label=name)
    logarithmic = axes.get_xscale() == "log"
    marked = [
        (float(np.sqrt(low * high)) if logarithmic else 0.5 * (low + high), ratio)
        for low, high, ratio, beyond in levels
        if beyond
    ]
    axes.plot([at for at, _ in marked], [ratio for _, ratio in marked], **look.points, markersize=4)


@styled
def forces(comparisons: Sequence[Comparison], name: str = "forces") -> str:
    """The mean missing force by each coordinate, with bands; empty if the record determines it for none."""
    ranked: dict[tuple[str, str], float] = {}
    for comparison in comparisons:
        for each in comparison.views.binned:
            if any(term is not None for term in each.terms):
                ranked.setdefault((each.joint, each.coordinate.name), each.explained)
    places = sorted(ranked, key=lambda place: -ranked[place])[:MOST_PANELS]
    if not places:
        return ""
    columns = min(COLUMNS, len(places))
    rows = -(-len(places) // columns)
    figure = Figure(figsize=(WIDTH, 0.4 + 2.0 * rows), layout="constrained")
    panels = figure.subplots(rows, columns, squeeze=False).ravel()
    several = len({joint for joint, _ in places}) > 1
    for number, (axes, (joint, coordinate)) in enumerate(zip(panels, places, strict=False)):
        for comparison, look in zip(comparisons, looks(len(comparisons)), strict=True):
            for each in comparison.views.binned:
                if (each.joint, each.coordinate.name) == (joint, coordinate):
                    _by_coordinate(axes, each, look, comparison.name)
                    _, unit = shown(each.coordinate.unit)
                    axes.set_xlabel(f"{coordinate}, {unit}")
                    axes.set_ylabel(("" if number % columns and not several else f"{joint}: ") + each.unit)
        axes.axhline(0.0, color=FLOOR, linewidth=0.9)
        axes.xaxis.set_major_locator(MaxNLocator(4, steps=[1, 2, 5, 10]))
        axes.yaxis.set_major_locator(MaxNLocator(5))
    for axes in panels[len(places) :]:
        axes.remove()
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(handles, [f"{label} (band: ±{BAND:g} std)" for label in labels], loc="outside upper left", ncols=2)
    return svg(figure, name, "Mean missing force by coordinate")


def _by_coordinate(axes: Axes, binned: Binned, look: Look, name: str) -> None:
    factor, _ = shown(binned.coordinate.unit)
    edges = factor * binned.edges
    unknown = float("nan")
    means = np.array([unknown if term is None else term.force for term in binned.terms])
    band = BAND * np.array([unknown if term is None else term.std for term in binned.terms])
    for low, high, mean, half in zip(edges[:-1], edges[1:], means, band, strict=True):
        axes.fill_between([low, high], mean - half, mean + half, color=look.colour, alpha=0.22, linewidth=0.0)
    axes.plot(np.repeat(edges, 2)[1:-1], np.repeat(means, 2), **look.line)
    axes.plot(0.5 * (edges[1:] + edges[:-1]), means, **look.points, markersize=3.2, label=name)


@styled
def staircase(names: Sequence[str], ratios: Sequence[float]) -> str:
    """The error falling: innovation energy over the floor for each of `names`, one step after another."""
    figure = Figure(figsize=(WIDTH, 2.4), layout="constrained")
    axes = figure.subplots()
    places = np.arange(len(names), dtype=np.float64)
    lowest = min(0.7, 0.7 * min(ratios))
    axes.bar(
        places, np.array(ratios) - lowest, bottom=lowest, width=0.55, color="#56B4E9", edgecolor="black", linewidth=0.6
    )
    for place, ratio in zip(places.tolist(), ratios, strict=True):
        axes.annotate(
            f"{ratio:.3g}" if ratio < 1e4 else f"{ratio:.1e}", (place, ratio), xytext=(0, 3),
            textcoords="offset points", ha="center", fontweight="bold",
        )  # fmt: skip
    axes.axhline(1.0, color=FLOOR, linewidth=1.4)
    axes.annotate(
        "noise alone", (1.0, 1.0), xycoords=("axes fraction", "data"), xytext=(-2, 2), textcoords="offset points",
        ha="right", va="bottom", color=FLOOR, fontsize=7,
    )  # fmt: skip
    # Space for three steps at least, and on the right for the words.
    right = max(len(names), 3)
    axes.set(yscale="log", ylabel="innovation energy\nrelative to noise", xlim=(-0.6, 1.12 * right - 0.4))
    axes.set_ylim(lowest, 2.0 * max(*ratios, 1.0))
    broken = [name.replace("_", "_\n") if len(names) > MOST_IN_ONE_LINE else name for name in names]
    axes.set_xticks(places, broken, parse_math=False)
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.yaxis.set_minor_formatter(NullFormatter())
    axes.grid(False, axis="x")
    return svg(figure, "staircase", "Innovation energy relative to noise, step by step")
