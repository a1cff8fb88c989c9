"""Read a recording to estimate from: of any kind, at the instants of its samples, with notes about what is unusual.

Without a vehicle nothing of the vehicles is imported, so that a script has its table at once.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from telemetry import storage
from telemetry.clock import with_regular_times
from telemetry.errors import RecordingError
from telemetry.recording import Recording

if TYPE_CHECKING:
    from vehicles.sections import VehicleFile


def read(
    path: Path, vehicle: VehicleFile | None = None, *, as_stamped: bool = False, database: Path | None = None
) -> tuple[Recording, tuple[str, ...]]:
    """The recording at `path`, and sentences about it: a file that was cut off, a fall of the vehicle.

    Jittering time stamps of samples that are equidistant are replaced by those of the sampling clock, unless
    `as_stamped`: to replay or convert a recording. Without a `vehicle` it is of a machine that has only a model.
    `database` is a DBC, for the signals of a CAN log. Raises RecordingError.
    """
    if vehicle is not None:
        from service.offline.replay import load

        recording = load(path, vehicle, database)
    elif _is_can_log(path):
        remedy = "Name the vehicle whose frames it holds."
        raise RecordingError(str(path), "", "is a CAN log, which only a vehicle file explains", remedy=remedy)
    else:
        recording = storage.load(path)
    if not as_stamped:
        recording = with_regular_times(recording)
    return recording, tuple(filter(None, (recording.truncated, _fall(recording, vehicle))))


def _is_can_log(path: Path) -> bool:
    from service.offline.can_log import is_can_log

    return is_can_log(path)


def _fall(recording: Recording, vehicle: VehicleFile | None) -> str:
    """A sentence about the fall of the vehicle; "" if it did not fall."""
    if vehicle is None:
        return ""
    from estimators.data.segments import falls_at
    from vehicles.registry import nominal_model

    falls = falls_at(nominal_model(vehicle.vehicle.kind), recording, vehicle.support)
    if falls is None:
        return ""
    why = recording.metadata.get("end_reason", "").rstrip(".")
    return f"the vehicle falls {falls:.1f} s after the start{f' ({why})' if why else ''}. No fit uses the rest."
