"""Compare models with recordings, recording by recording: what `upright compare` and `upright.compare` do."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path

from upright.diagnosis.prediction.compare import Comparison, compare
from upright.models.model import Model
from upright.service.offline.inputs.machine import as_measured, loops_of, support_of
from upright.service.offline.inputs.question import asked_of
from upright.telemetry.recording import Recording
from upright.vehicles.experiment.load import with_load
from upright.vehicles.sections import VehicleFile


def compared(
    recordings: Sequence[Recording],
    models: Mapping[str, Model],
    vehicle: VehicleFile | None,
    progress: Callable[[str], None] = lambda text: None,
) -> Iterator[list[Comparison]]:
    """For each recording in turn, all `models`, by name. The first model decides whether they are of the `vehicle`,
    whose supports, load and recorded loop are then taken into account. `progress` gets the current step.

    Raises DataError, ModelError and EstimationError.
    """
    subject = next(iter(models.values()))
    support = support_of(subject, vehicle)
    if asked := asked_of(subject, recordings, support):
        raise asked
    for recording in recordings:
        progress(f"comparing: {Path(recording.source).name}")
        loaded = {name: with_load(as_measured(each, vehicle, [recording]), recording) for name, each in models.items()}
        loops = loops_of(subject, vehicle, [recording])
        yield compare(loaded, [recording], support=support, loops=loops, progress=progress)
