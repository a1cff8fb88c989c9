"""The samples of a recording, made by the same code in the live loop and in a replay of raw frames.

A recorded sample consists of the roll filter's state at an IMU sample, the drive values known by then, and the
setpoints that were sent in response. The kind of vehicle defines the channels. The setpoints are known at once in the
live loop; in a raw log, they are known when the frames up to the next IMU sample have been read.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Any

from upright.drivers.cia402.states import State
from upright.drivers.vehicle_io import VehicleIo
from upright.estimators.roll_filter import RollFilter, RollState
from upright.telemetry.samples import CanFrame, Frame
from upright.vehicles.contract import Command, Kind, Measurement

NAN = float("nan")
UNKNOWN = Command(State.UNKNOWN, NAN, NAN, NAN)
"""Values that a log does not contain: reference and excitation were never on the bus."""


def row(kind: Kind[Any], attitude: RollState, drives: Measurement, command: Command, phase: float) -> Frame:
    """The recorded sample of one cycle, in the order of the kind's channels."""
    return Frame(attitude.timestamp_ns, kind.values(attitude, drives, command, phase))


def rows_from_frames(
    frames: Iterable[CanFrame], io: VehicleIo, kind: Kind[Any], roll_filter: RollFilter, start_ns: int = 0
) -> Iterator[Frame]:
    """The samples that the daemon recorded, from the raw frames of a log that begins at `start_ns`.

    Reference, excitation and phase were never on the bus: they are NaN. If the log ends before the setpoints of the
    last sample, it has the previous setpoints.
    """
    io.reset(start_ns)
    roll_filter.reset()
    attitude: RollState | None = None
    drives: Measurement | None = None
    for frame in frames:
        sample = io.handle(frame)
        if sample is None:
            continue
        if attitude is not None and drives is not None and drives.timestamp_ns:
            yield row(kind, attitude, drives, UNKNOWN, NAN)
        attitude = roll_filter.update(sample)
        drives = kind.measure()
    if attitude is not None and drives is not None and drives.timestamp_ns:
        yield row(kind, attitude, drives, UNKNOWN, NAN)
