"""Read a recording to estimate from: of any kind, at the instants of its samples, with notes about what is unusual.

Without a vehicle nothing of the vehicles is imported, so that a script has its table at once.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from upright.telemetry import storage
from upright.telemetry.clock import with_regular_times
from upright.telemetry.errors import RecordingError
from upright.telemetry.recording import Recording
from upright.telemetry.tables.mapping import NOTHING, Said

if TYPE_CHECKING:
    from upright.models.model import Model
    from upright.telemetry.tables.wanted import Wanted
    from upright.vehicles.sections import VehicleFile


def read(
    path: Path,
    vehicle: VehicleFile | None = None,
    models: Sequence[Model] | None = None,
    user: Said = NOTHING,
    database: Path | None = None,
) -> tuple[Recording, tuple[str, ...]]:
    """The longest of the recordings of `read_all`, and sentences about it. Raises RecordingError, for a `database` of a
    file that is no CAN log, too."""
    if database is not None and path.exists() and not _is_can_log(path):
        remedy = "Leave the DBC out, or name a CAN log."
        raise RecordingError(str(path), "", "is no CAN log, whose signals a DBC could name", remedy=remedy)
    return max(read_all(path, vehicle, models, user, database=database), key=lambda each: len(each[0]))


def read_all(
    path: Path,
    vehicle: VehicleFile | None = None,
    models: Sequence[Model] | None = None,
    user: Said | None = None,
    *,
    as_stamped: bool = False,
    database: Path | None = None,
) -> Iterator[tuple[Recording, tuple[str, ...]]]:
    """The recordings at `path`, several if a logger began anew in it, each with sentences about it: a file that was cut
    off, a fall of the vehicle.

    They have the channels that `models` need, by default those of the `vehicle`; without one they are of a machine that
    has only a model. `user` is what the user says of a table. Jittering time stamps of samples that are equidistant are
    replaced by those of the sampling clock, unless `as_stamped`: to replay or convert a recording. `database` is a DBC,
    for the signals of a CAN log. Raises RecordingError.
    """
    for recording in _loaded(path, vehicle, models, user or NOTHING, database):
        each = recording if as_stamped else with_regular_times(recording)
        yield each, tuple(filter(None, (each.truncated, _fall(each, vehicle, models))))


def _loaded(
    path: Path, vehicle: VehicleFile | None, models: Sequence[Model] | None, user: Said, database: Path | None
) -> Sequence[Recording]:
    if vehicle is not None:
        from upright.service.offline.inputs.replay import load_all

        return load_all(path, vehicle, models, user, database)
    needed = _wanted(models) if models else ()
    if _is_can_log(path):
        if database is not None:
            from upright.service.offline.inputs.dbc import read_signals

            return read_signals(path, database, needed, user)
        remedy = "Name the vehicle whose frames it holds, or a DBC that names their signals."
        raise RecordingError(str(path), "", "is a CAN log, which only a vehicle file explains", remedy=remedy)
    return storage.load_all(path, needed, user)


def _wanted(models: Sequence[Model]) -> Sequence[Wanted]:
    from upright.service.offline.inputs.wanted import wanted

    return wanted(models)


def _is_can_log(path: Path) -> bool:
    from upright.service.offline.inputs.can_log import is_can_log

    return is_can_log(path)


def _fall(recording: Recording, vehicle: VehicleFile | None, models: Sequence[Model] | None) -> str:
    """A sentence about the fall of the vehicle; "" if it did not fall, or if the recording is of another machine."""
    if vehicle is None:
        return ""
    from upright.estimators.data.segments import falls_at
    from upright.service.offline.inputs.machine import is_of
    from upright.vehicles.registry import nominal_model

    if models is not None and not any(is_of(each, vehicle) for each in models):
        return ""

    falls = falls_at(nominal_model(vehicle.vehicle.kind), recording, vehicle.support)
    if falls is None:
        return ""
    why = recording.metadata.get("end_reason", "").rstrip(".")
    return f"the vehicle falls {falls:.1f} s after the start{f' ({why})' if why else ''}. No fit uses the rest."
