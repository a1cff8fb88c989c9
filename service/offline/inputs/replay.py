"""Read recordings from any file or from raw frames, replay them through the live estimators, convert them.

A recording begins at an agreed time at which the daemon discarded all earlier measurements, so that the raw log that
begins at the same time reproduces the same samples bit by bit. Values that were never on the bus (`not_on_the_bus`) are
taken, by time stamp, from the recording beside the log; without it, they are unknown (NaN).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from upright.estimators.budget import UNLIMITED, Budget
from upright.models.model import Model
from upright.service.control import assembly
from upright.service.control.cycle.rows import rows_from_frames
from upright.service.observer.live.online_estimators import EstimatorBank, estimators_of
from upright.service.offline import export
from upright.service.offline.inputs import can_log
from upright.service.offline.inputs.machine import is_of, refuse_foreign
from upright.service.offline.inputs.wanted import wanted
from upright.telemetry import storage
from upright.telemetry.channels import ChannelTable
from upright.telemetry.errors import RecordingError
from upright.telemetry.recording import Recording
from upright.telemetry.tables.mapping import NOTHING, Said, columns_of
from upright.vehicles import registry
from upright.vehicles.file import VehicleFile

AGE = "drive_age"
"""The channels after this one, reference, excitation and phase, were never on the bus."""
BATCH = 1000
"""Samples between two checks of the time."""

CONVERTED = (*storage.SUFFIXES, *export.SUFFIXES)


def load(path: Path, vehicle: VehicleFile, database: Path | None = None) -> Recording:
    """A recording of the vehicle from a file of any kind, including CAN logs, with its original time stamps.

    Raises:
        RecordingError: the file cannot be read, or contains no frames of this vehicle.
    """
    return max(load_all(path, vehicle, database=database), key=len)


def load_all(
    path: Path,
    vehicle: VehicleFile,
    models: Sequence[Model] | None = None,
    user: Said = NOTHING,
    database: Path | None = None,
) -> Sequence[Recording]:
    """The recordings in a file: several if a logger began anew in it. They have the channels that `models` need, by
    default the vehicle's own; `user` is what the user says of the columns.

    `database` is a DBC: the signals that it names in a CAN log, in place of the vehicle's channels. For `models`, they
    are read as the columns of a table.

    Raises:
        RecordingError: the file cannot be read, contains no frames of this vehicle, or is of another machine.
    """
    if database is not None and models is None:
        from upright.service.offline.inputs.dbc import read_signals

        return read_signals(path, database, (), user)
    is_log = can_log.is_can_log(path)
    if is_log and database is None:
        return (from_raw_log(path, vehicle),)
    own = models is None or any(is_of(each, vehicle) for each in models)
    said = replace(user, columns={**columns_of(vehicle.columns), **user.columns}) if own else user
    needed = wanted(models or (), vehicle if own else None)
    if is_log and database is not None:
        from upright.service.offline.inputs.dbc import read_signals

        found = read_signals(path, database, needed, said)
    else:
        found = storage.load_all(path, needed, said)
    if not own:
        return found
    for each in found:
        refuse_foreign(each, vehicle)
    return tuple(with_age(each, vehicle) for each in found)


def with_age(recording: Recording, vehicle: VehicleFile) -> Recording:
    """The recording with the channel AGE. If it is missing, as in recordings by others, it is set to zero: the drives
    are then assumed to be sampled together with the other channels.

    A recording without any channel of the vehicle is of another machine, and is not changed.
    """
    table = assembly.channels(vehicle)
    foreign = set(table.names).isdisjoint(recording.values)
    if foreign or AGE in recording.values or AGE not in table.names or recording.rate <= 0.0:
        return recording
    note = f"there is no channel {AGE}: the drives are assumed to be sampled with the other channels, up to an offset"
    return replace(
        recording,
        channels=ChannelTable((*recording.channels, table[table.index_of(AGE)])),
        values={**recording.values, AGE: np.zeros(len(recording))},
        truncated="; ".join(filter(None, (recording.truncated, note))),
    )


def from_raw_log(path: Path, vehicle: VehicleFile) -> Recording:
    """The recording that the daemon made, or would have made, from the frames in a CAN log of any format.

    Raises:
        RecordingError: there is no CAN frame in it, or the frames give no complete sample.
    """
    channels = assembly.channels(vehicle)
    io = assembly.vehicle_io(vehicle)
    log = can_log.open_log(path)
    notes: list[str] = []
    frames = can_log.of_vehicle(log, io, vehicle, notes)
    rows = list(rows_from_frames(frames, io, registry.kind_of(vehicle, io), assembly.roll_filter(vehicle)))
    if not rows:
        what = f"its frames give no complete sample: {_missing(io)}; it holds {can_log.ids(log)}"
        raise RecordingError(str(path), "", what, remedy=_CHECK)
    table = np.array([row.values for row in rows], dtype=np.float64)
    rebuilt = Recording(
        channels=channels,
        timestamp_ns=np.array([row.timestamp_ns for row in rows], dtype=np.int64),
        values={name: table[:, place].copy() for place, name in enumerate(channels.names)},
        metadata={
            "vehicle": vehicle.vehicle.id,
            "kind": vehicle.vehicle.kind,
            "rate": str(vehicle.control.rate),
            "support": repr(vehicle.support),
        },
        truncated="; ".join(filter(None, (*notes, log.truncated))),
        source=str(path),
    )
    beside = Path(path).with_suffix(".arrow")
    try:
        if beside.exists():
            return _completed(rebuilt, storage.load(beside))
        why = f"there is no {beside.name} beside the log"
    except RecordingError as error:
        why = str(error)
    notes = [rebuilt.truncated, f"{', '.join(not_on_the_bus(channels))} are unknown: {why}"]
    return replace(rebuilt, truncated="; ".join(filter(None, notes)))


def not_on_the_bus(channels: ChannelTable) -> tuple[str, ...]:
    """The channels that are in no frame: references, excitation and phase."""
    return channels.names[channels.index_of(AGE) + 1 :]


def replay(recording: Recording, vehicle: VehicleFile) -> dict[str, Any]:
    """Replay a recording through the live estimators; return the results by method, as at the end of the live run.

    Raises:
        RecordingError: a channel that the estimators need is missing.
    """
    return _replayed(recording, vehicle).results()


def live_diagnosis(recording: Recording, vehicle: VehicleFile, budget: Budget = UNLIMITED) -> dict[str, Any] | None:
    """The live diagnosis of a replay of the recording; None for a kind of vehicle without a live diagnosis.

    Raises RecordingError like `replay`, and OutOfTime after `budget`.
    """
    return _replayed(recording, vehicle, budget).diagnosis()


def _replayed(recording: Recording, vehicle: VehicleFile, budget: Budget = UNLIMITED) -> EstimatorBank:
    bank = estimators_of(vehicle)
    bank.of_recording(recording.metadata)
    bank.join()
    frames = list(recording.frames(assembly.channels(vehicle)))
    for begin in range(0, len(frames), BATCH):
        budget.check()
        bank.update(frames[begin : begin + BATCH])
    return bank


def convert(recording: Recording, path: Path) -> None:
    """Write `recording` to `path` by its suffix, one of CONVERTED.

    Raises:
        RecordingError: the format is not known, or `path` cannot be written.
    """
    path = Path(path)
    if path.suffix not in CONVERTED:
        what = f"upright does not write {path.suffix or 'files without a suffix'}"
        raise RecordingError(str(path), "", what, remedy=f"Use one of {', '.join(CONVERTED)}.")
    try:
        if path.suffix in export.SUFFIXES:
            export.export(recording, path)
        else:
            storage.save(recording, path)
    except OSError as error:
        raise RecordingError(
            str(path),
            "",
            f"cannot be written: {error.strerror or error}",
            remedy="Check the folder and its permissions.",
        ) from error


_CHECK = "Compare the log's CAN ids with [imu] and [[drive]] of the vehicle file (`upright config show`)."


def _missing(io: Any) -> str:
    """What is missing in the frames, as text."""
    if io.imu.statistics.sets == 0:
        return io.imu.fault_text or f"no complete IMU frame set (ids {', '.join(f'{i:X}' for i in io.imu.can_ids)})"
    silent = [drive.config.name for drive in io.drives if drive.timestamp_ns == 0]
    return f"no values from {', '.join(silent)}"


def _completed(rebuilt: Recording, beside: Recording) -> Recording:
    """`rebuilt` with the values that only the recording beside it has."""
    _, here, there = np.intersect1d(rebuilt.timestamp_ns, beside.timestamp_ns, return_indices=True)
    values = dict(rebuilt.values)
    for name in set(not_on_the_bus(rebuilt.channels)).intersection(beside.channels.names):
        values[name] = np.full(len(rebuilt), np.nan)
        values[name][here] = beside.values[name][there]
    return replace(rebuilt, values=values, metadata={**rebuilt.metadata, **beside.metadata})
