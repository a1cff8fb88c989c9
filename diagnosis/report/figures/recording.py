"""The channels of a recording over time, below each other. Drawn without pyplot: no display, no global state."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from upright.diagnosis.report.figures.drawing import Array, Picture, thinned
from upright.diagnosis.report.names import shown
from upright.telemetry.recording import Recording


def recording_figure(recording: Recording, channels: Sequence[str] = ()) -> Picture:
    """`channels`, by default those that change. Raises RecordingError for one that there is not."""
    recording.require(*channels)
    table = recording.channels
    names = list(channels) or [name for name in table.names if _changes(recording[name])] or list(table.names)
    figure = Picture(figsize=(9.0, 0.6 + 1.3 * len(names)), layout="constrained")
    rows = figure.subplots(len(names), 1, sharex=True, squeeze=False)[:, 0]
    for axes, name in zip(rows, names, strict=True):
        factor, unit = shown(table[table.index_of(name)].unit)
        time, values = thinned(recording.time, factor * recording[name])
        axes.plot(time, values, linewidth=0.9)
        axes.set_ylabel(f"{name}\n{unit}", fontsize=8)
        axes.grid(color="0.9", linewidth=0.5)
    rows[-1].set_xlabel("s")
    return figure


def _changes(values: Array) -> bool:
    known = values[np.isfinite(values)]
    return len(known) > 0 and float(np.ptp(known)) > 0.0
