"""Pictures of a comparison: prediction over measurement, and the missing torque by time, frequency and coordinate.

Drawn without pyplot: no display, no global state. Angles in degrees, torques in N m.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from scipy.signal import welch

from diagnosis.compare import BINS, MissingTorque, ModelComparison
from telemetry.recording import Recording

AXES = {"roll": "roll, deg", "precession": "precession, deg", "roll_rate": "roll rate, deg/s"}
LEGEND_ROOM = 0.35


def save_comparison(comparisons: Sequence[ModelComparison], recording: Recording, path: Path) -> None:
    """Write `comparison_figure` to `path`; its suffix (.png, .svg, .pdf) is the format."""
    comparison_figure(comparisons, recording).savefig(path, dpi=130)


def comparison_figure(comparisons: Sequence[ModelComparison], recording: Recording) -> Figure:
    """Overlay of roll; missing torque by time, frequency, roll, precession and roll rate. A colour a model."""
    figure = Figure(figsize=(12.0, 9.0), layout="constrained")
    grid = figure.add_gridspec(3, 6)
    overlay, time = figure.add_subplot(grid[0, :]), figure.add_subplot(grid[1, :4])
    spectrum = figure.add_subplot(grid[1, 4:])
    colours = mpl.color_sequences["tab10"]
    overlay.plot(recording.time, np.degrees(recording["roll"]), color="0.75", linewidth=2.5, label="measured")
    for comparison, colour in zip(comparisons, colours, strict=False):
        verdict = "adequate" if comparison.adequate else "not adequate"
        if comparison.predictions:
            last = comparison.predictions[-1]
            label = f"{comparison.name}, {last.horizon:g} s ahead: {last.fit_percent('roll'):.1f} %, {verdict}"
            gaps = np.where(np.append(0.0, np.abs(np.diff(last.time))) > 0.1, np.nan, 0.0)
            overlay.plot(last.time, np.degrees(last.predicted["roll"]) + gaps, color=colour, linewidth=0.9, label=label)
        if comparison.missing_torque is not None:
            _draw_time(time, comparison.missing_torque, colour)
            _draw_spectrum(spectrum, comparison.missing_torque, colour)
    if comparisons and comparisons[0].missing_torque is not None:
        floor = comparisons[0].missing_torque
        time.axhspan(-2.0 * floor.floor, 2.0 * floor.floor, color="0.9", zorder=0, label="sensor noise, 2 std")
        time.legend(loc="upper right", fontsize=8)
        spectrum.plot(
            floor.floor_density[0][1:], np.sqrt(floor.floor_density[1][1:]), color="0.6", label="sensor noise"
        )
        spectrum.legend(loc="lower left", fontsize=8)
    for place, (name, label) in enumerate(AXES.items()):
        axes = figure.add_subplot(grid[2, 2 * place : 2 * place + 2])
        for comparison, colour in zip(comparisons, colours, strict=False):
            if comparison.missing_torque is not None:
                _draw_coordinate(axes, comparison.missing_torque, name, colour)
        axes.axhline(0.0, color="0.6", linewidth=0.8)
        axes.set(xlabel=label, ylabel="missing torque, N m" if place == 0 else "")
    low, high = overlay.get_ylim()
    overlay.set(ylabel="roll, deg", xlabel="s", xlim=(0.0, recording.duration))
    overlay.set_ylim(low, high + LEGEND_ROOM * (high - low))
    overlay.legend(loc="upper right", fontsize=8, ncols=2)
    time.set(ylabel="missing torque, N m", xlabel="s", xlim=(0.0, recording.duration))
    spectrum.set(xscale="log", yscale="log", xlabel="Hz", ylabel="N m / sqrt(Hz)", xlim=(0.1, 10.0))
    return figure


def _draw_time(axes: Axes, missing: MissingTorque, colour: object) -> None:
    breaks = np.where(np.append(0, np.diff(missing.runs)) > 0, np.nan, 0.0)
    axes.plot(missing.time, missing.torque + breaks, color=colour, linewidth=0.7)


def _draw_spectrum(axes: Axes, missing: MissingTorque, colour: object) -> None:
    segment = min(len(missing.torque), round(8.0 / missing.stride))
    frequency, power = welch(missing.torque, 1.0 / missing.stride, nperseg=segment)
    axes.plot(frequency[1:], np.sqrt(power[1:]), color=colour, linewidth=0.9)
    shown = (frequency > 0.1) & (frequency < 10.0)
    low, high = axes.get_ylim() if len(axes.lines) > 1 else (np.inf, 0.0)
    values = np.sqrt(power[shown])
    axes.set_ylim(min(low, 0.5 * float(values.min())), max(high, 2.0 * float(values.max())))


def _draw_coordinate(axes: Axes, missing: MissingTorque, name: str, colour: object) -> None:
    coordinate = np.degrees(missing.coordinates[name])
    axes.plot(coordinate, missing.torque, ".", color=colour, markersize=1.2, alpha=0.25)
    edges = np.linspace(coordinate.min(), coordinate.max(), BINS + 1)
    bins = np.clip(np.searchsorted(edges, coordinate, side="right") - 1, 0, BINS - 1)
    filled = [place for place in range(BINS) if np.any(bins == place)]
    centres = [0.5 * (edges[place] + edges[place + 1]) for place in filled]
    axes.plot(centres, [np.mean(missing.torque[bins == place]) for place in filled], "o-", color=colour, markersize=4)
