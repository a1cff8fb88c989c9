"""Picture of the confusion matrices: a panel per method, a row per hidden effect, a column per name."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from upright.models.effects.catalogue import CATALOGUE
from upright.service.hidden_effects.results.summary import Summary
from upright.telemetry.errors import UprightError

CELL = 0.24
"""Size of a cell, inches."""


def confusion_picture(summary: Summary) -> Figure:
    """Shares of each row, with its number of cases at the end; the right name is framed. Raises UprightError."""
    order = [*CATALOGUE, "unknown", "nothing", "insufficient data", "failed"]
    place = {name: number for number, name in enumerate(order)}
    tables = {name: merit.confusion for name, merit in summary.methods.items() if merit.confusion}
    if not tables:
        raise UprightError(
            "There is no case with a hidden effect to draw.",
            remedy="Run cases with twice the minimum detectable effect or more.",
        )
    rows = sorted({row for table in tables.values() for row in table}, key=lambda row: (place.get(row, 99), row))
    columns = sorted({c for table in tables.values() for row in table.values() for c in row}, key=lambda c: place[c])
    width = len(tables) * (CELL * len(columns) + 0.6) + 2.6
    figure = Figure(figsize=(width, CELL * len(rows) + 3.2), layout="constrained")
    panels = figure.subplots(1, len(tables), sharey=True, squeeze=False)[0]
    for panel, (name, table) in zip(panels, tables.items(), strict=True):
        counts = np.array([[table.get(row, {}).get(column, 0) for column in columns] for row in rows], dtype=float)
        total = counts.sum(axis=1, keepdims=True)
        panel.imshow(counts / np.maximum(total, 1.0), vmin=0.0, vmax=1.0, cmap="Blues", aspect="equal")
        panel.set_title(name, fontsize=9)
        panel.set_xticks(range(len(columns)), columns, rotation=90, fontsize=7)
        panel.set_yticks(range(len(rows)), rows, fontsize=7)
        panel.set_xticks(np.arange(len(columns) + 1) - 0.5, minor=True)
        panel.set_yticks(np.arange(len(rows) + 1) - 0.5, minor=True)
        panel.grid(which="minor", color="0.85", linewidth=0.5)
        panel.tick_params(which="both", length=0)
        for row, label in enumerate(rows):
            if label in columns:
                corner = (columns.index(label) - 0.5, row - 0.5)
                panel.add_patch(Rectangle(corner, 1.0, 1.0, fill=False, edgecolor="tab:orange", linewidth=1.2))
            panel.text(len(columns) - 0.4, row, f"{int(total[row, 0])}", fontsize=6, va="center")
    figure.supxlabel("named first", fontsize=9)
    figure.supylabel("hidden", fontsize=9)
    return figure


def save_confusion(summary: Summary, path: Path) -> None:
    """Save the picture. Raises UprightError if there is nothing to draw."""
    confusion_picture(summary).savefig(path, dpi=150)
