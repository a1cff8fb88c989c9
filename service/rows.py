"""What one row of a recording is made of; the same code for the live loop and for a replay of raw frames.

A row is the roll filter's state at an IMU sample, the drive values known by then, and the setpoints that were sent in
answer. Live, the setpoints are known at once; from a raw log, when the frames up to the next IMU sample have passed.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator

from drivers.vehicle_io import Measurement, VehicleIo
from estimators.roll_filter import RollFilter, RollState
from telemetry.samples import CanFrame, Frame

NAN = float("nan")


def row(
    roll: RollState, drives: Measurement, io: VehicleIo, reference: float, excitation: float, phase: float
) -> Frame:
    """The row of one cycle, in the order of `telemetry.channels.MONOCAB`."""
    return Frame(
        roll.timestamp_ns,
        (
            roll.roll,
            roll.roll_rate,
            roll.roll_std,
            roll.pitch,
            drives.precession,
            drives.precession_rate,
            io.precession_rate_setpoint,
            drives.trim_position,
            drives.trim_rate,
            io.trim_rate_setpoint,
            (roll.timestamp_ns - drives.timestamp_ns) * 1e-9,
            reference,
            excitation,
            phase,
        ),
    )


def rows_from_frames(
    frames: Iterable[CanFrame], io: VehicleIo, roll_filter: RollFilter, start_ns: int = 0
) -> Iterator[Frame]:
    """The rows that the daemon recorded, from the raw frames of a log that begins at `start_ns`.

    Reference, excitation and phase were never on the bus: they are NaN. A last row whose setpoints were not seen any
    more is given with the setpoints before.
    """
    io.reset(start_ns)
    roll_filter.reset()
    roll: RollState | None = None
    drives: Measurement | None = None
    for frame in frames:
        sample = io.handle(frame)
        if sample is None:
            continue
        if roll is not None and drives is not None and drives.timestamp_ns:
            yield row(roll, drives, io, NAN, NAN, NAN)
        roll = roll_filter.update(sample)
        drives = io.measurement()
    if roll is not None and drives is not None and drives.timestamp_ns:
        yield row(roll, drives, io, NAN, NAN, NAN)
