"""The picture of a run: the motion of the vehicle and, if it is estimated live, the convergence of the parameters.

It is the result of `upright demo`, drawn from the recording alone, by running it through the live estimator.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from upright.service.control import assembly
from upright.telemetry.recording import Recording
from upright.vehicles import registry
from upright.vehicles.experiment.phases import Phase
from upright.vehicles.file import VehicleFile
from upright.vehicles.views import DARK, LIGHT, Panel, Story

PERIOD = 0.25
"""s between two points of the estimates."""
BAND = 1.96
"""Standard deviations of a 95 % band."""
CAD = "#b2182b"


def save_run(recording: Recording, vehicle: VehicleFile, path: Path) -> None:
    """Draw `recording` to the PNG at `path`. Raises RecordingError if a channel is missing."""
    story = registry.of(vehicle.vehicle.kind).views.story
    figure = Figure(figsize=(9.0, 7.5), layout="constrained")
    axes = figure.subplots(len(story.panels) + len(story.settling), 1, sharex=True)
    motion, parameters = axes[: len(story.panels)], axes[len(story.panels) :]
    figure.suptitle(f"{recording.metadata.get('vehicle', '')}: {recording.metadata.get('experiment', '')}")
    for place, panel in zip(motion, story.panels, strict=True):
        _motion(place, panel, recording)
    _phases(list(motion), recording)
    if story.settling:
        _parameters(list(parameters), story, recording, vehicle)
    axes[-1].set_xlabel("time, s")
    for each in figure.axes:
        each.grid(alpha=0.25)
        each.spines[["top", "right"]].set_visible(False)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=130)


def _motion(axes: Axes, panel: Panel, recording: Recording) -> None:
    for channel, colour, legend in panel.lines:
        values = panel.scale * recording[channel]
        axes.plot(recording.time, values, color=colour, linewidth=1.0, label=legend or None)
    axes.set_ylabel(f"{panel.title}, {panel.unit}")
    if any(legend for _, _, legend in panel.lines):
        axes.legend(loc="upper right", frameon=False, ncols=2, fontsize="small")


def _phases(places: list[Axes], recording: Recording) -> None:
    time, phases = recording.time, recording["phase"]
    for begin in np.flatnonzero(np.diff(phases, prepend=-1.0)):
        phase = Phase(int(phases[begin]))
        if phase in (Phase.RISE, Phase.EXCITE, Phase.LOWER):
            for axes in places:
                axes.axvline(time[begin], color="0.6", linewidth=0.8, linestyle=":")
            places[0].annotate(
                phase.name.lower(),
                (time[begin], 1.0),
                xycoords=("data", "axes fraction"),
                fontsize="small",
                color="0.4",
            )


def _parameters(places: list[Axes], story: Story, recording: Recording, vehicle: VehicleFile) -> None:
    kind, known = registry.of(vehicle.vehicle.kind), vehicle.parameters
    regression = next(iter(kind.identification().regressions.values()))
    estimator = regression.make(known.values, known.deviations, vehicle.support, kind.channels)
    seen: dict[str, list[tuple[float, float, float]]] = {name: [] for name, _ in story.settling}
    start_ns, due_ns = int(recording.timestamp_ns[0]), 0
    for frame in recording.frames(assembly.channels(vehicle)):
        estimator.update(frame)
        if frame.timestamp_ns >= due_ns:
            due_ns = frame.timestamp_ns + round(PERIOD * 1e9)
            for name, entry in estimator.result().parameters.items():
                if name in seen and entry.value is not None and entry.std is not None:
                    seen[name].append(((frame.timestamp_ns - start_ns) * 1e-9, entry.value, entry.std))
    for axes, (name, unit) in zip(places, story.settling, strict=True):
        cad = vehicle.parameters.values[name]
        axes.axhline(cad, color=CAD, linewidth=1.0, linestyle="--", label="CAD")
        if seen[name]:
            time, value, std = np.array(seen[name]).T
            axes.fill_between(time, value - BAND * std, value + BAND * std, color=LIGHT, alpha=0.7, linewidth=0)
            axes.plot(time, value, color=DARK, linewidth=1.2, label="identified, with 95 % band")
            reach = max(abs(value[-1] - cad), 6.0 * std[-1], 0.02 * value[-1])
            axes.set_ylim(value[-1] - 1.3 * reach, value[-1] + 1.3 * reach)
        axes.set_ylabel(f"{name.replace('_', ' ')},\n{unit}")
        axes.legend(loc="upper right", frameon=False, ncols=2, fontsize="small")
