"""The report's figure of the closed loop: each channel as recorded and as simulated from the excitation on."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from upright.diagnosis.prediction.closed_loop_error import ClosedLoop
from upright.diagnosis.prediction.compare import Comparison
from upright.diagnosis.report.figures.diagnosis import BAND, IN_A_ROW
from upright.diagnosis.report.figures.drawing import (
    MEASURED,
    STYLE,
    WIDTH,
    Array,
    in_a_row,
    looks,
    styled,
    svg,
    thinned,
)
from upright.diagnosis.report.names import shown, units


@styled
def closed_loop(comparisons: Sequence[Comparison], name: str = "loop") -> str:
    """Every channel of the loop: recorded, simulated with each model, and the differences; "" if there is no loop."""
    figure = _figure(comparisons)
    if figure is None:
        return ""
    return svg(figure, name, "Recorded and simulated in the closed loop, by channel, and the differences")


def save_closed_loop(comparisons: Sequence[Comparison], path: Path) -> None:
    """The same as a picture; the suffix of `path` gives the format. No file if there is no loop."""
    with mpl.rc_context(STYLE):
        figure = _figure(comparisons)
        if figure is not None:
            figure.savefig(path, dpi=130)


def _figure(comparisons: Sequence[Comparison]) -> Figure | None:
    simulated = [(each, look) for each, look in zip(comparisons, looks(len(comparisons)), strict=True)]
    simulated = [(each, look) for each, look in simulated if each.closed_loop.measured]
    if not simulated:
        return None
    first = simulated[0][0]
    channels = list(first.closed_loop.measured)
    unit_of = units(first.innovations.problem.model)
    figure = Figure(figsize=(WIDTH, 0.45 + 2.5 * len(channels)), layout="constrained")
    ratios = [share for _ in channels for share in (1.5, 1.0)]
    panels = figure.subplots(2 * len(channels), 1, sharex=True, height_ratios=ratios, squeeze=False)[:, 0]
    for channel, upper, lower in zip(channels, panels[::2], panels[1::2], strict=True):
        factor, unit = shown(unit_of[channel])
        time, values = thinned(*_in_a_row(first.closed_loop, factor * first.closed_loop.measured[channel]))
        upper.plot(time, values, color=MEASURED, linewidth=2.2, label="measured")
        for comparison, look in simulated:
            each = comparison.closed_loop
            if channel in each.simulated:
                error = each.measured[channel] - each.simulated[channel]
                columns = _in_a_row(each, factor * each.simulated[channel], factor * error)
                time, values, error = thinned(*columns)
                upper.plot(time, values, **look.line, label=f"{comparison.name}, simulated")
                lower.plot(time, error, **look.line)
        floor = BAND * factor * min(each.closed_loop.floor[channel] for each, _ in simulated)
        lower.axhspan(-floor, floor, color="0.88", linewidth=0.0, zorder=0)
        most = float(np.max(np.abs(lower.dataLim.intervaly)))
        lower.set_ylim(-1.1 * max(most, 1.5 * floor), 1.1 * max(most, 1.5 * floor))
        upper.set_ylabel(f"{channel}, {unit}")
        lower.set_ylabel(f"error, {unit}")
    panels[-1].set_xlabel("s" if not first.closed_loop.part.any() else IN_A_ROW)
    handles, labels = panels[0].get_legend_handles_labels()
    handles.append(Patch(color="0.88"))
    labels.append(f"noise and disturbance alone (±{BAND:g} std)")
    figure.legend(handles, labels, loc="outside upper left", ncols=4)
    return figure


def _in_a_row(loop: ClosedLoop, *columns: Array) -> list[Array]:
    """The time of `loop` with one recording after the other, and `columns` with gaps between the recordings."""
    numbers = np.unique(loop.part)
    parts = [loop.time[loop.part == number] for number in numbers]
    shifts = in_a_row([float(part[0]) for part in parts], [float(part[-1]) for part in parts])
    gaps = np.where(np.diff(loop.part, prepend=loop.part[0]) != 0, np.nan, 0.0)
    return [loop.time + shifts[np.searchsorted(numbers, loop.part)], *(column + gaps for column in columns)]
