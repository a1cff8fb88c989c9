"""The samples of a recording, made by the same code in the live loop and in a replay of raw frames.

A recorded sample consists of the roll filter's state at an IMU sample, the drive values known by then, and the
setpoints that were sent in response. The kind of vehicle defines the channels.

In the live loop the setpoints are known at once. A raw log does not say which sample a set of setpoints answers. On a
machine that is held up, the next samples can be on the bus before an answer, or in the middle of it, and a sample that
waited behind others is not answered at all. What is certain: sets leave in the order of their samples, at most one a
sample, and none begins before its sample. Of what this allows, the latest sample is taken for each set.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any

from upright.drivers.cia402.states import State
from upright.drivers.foreign import SYNC_COB_ID
from upright.drivers.vehicle_io import VehicleIo
from upright.estimators.roll_filter import RollFilter, RollState
from upright.telemetry.samples import CanFrame, Frame
from upright.vehicles.contract import Command, Kind, Measurement

NAN = float("nan")
UNKNOWN = Command(State.UNKNOWN, NAN, NAN, NAN)
"""Values that a log does not contain: reference and excitation were never on the bus."""

HELD_BACK = 1000
"""Samples after which a sample has its answer: 2 s at 500 Hz. A loop that is late for that long has stopped its vehicle
(limits.missed_cycles), and the memory that a log of hours needs does not grow with it."""


def row(kind: Kind[Any], attitude: RollState, drives: Measurement, command: Command, phase: float) -> Frame:
    """The recorded sample of one cycle, in the order of the kind's channels."""
    return Frame(attitude.timestamp_ns, kind.values(attitude, drives, command, phase))


@dataclass(slots=True)
class _Answer:
    """A set of setpoint frames, and the number of the newest sample when it began."""

    newest: int
    frames: list[CanFrame]
    ended: bool = False


class _Answers:
    """The sets of setpoint frames in a log. A set ends with SYNC, or where one of its ids comes again."""

    def __init__(self, io: VehicleIo) -> None:
        self._ids = {can_id for drive in io.drives for can_id in drive.config.rpdo_codecs}
        self._all: list[_Answer] = []

    def take(self, frame: CanFrame, newest: int) -> bool:
        """Whether the frame belongs to a set; `newest` is the number of the newest sample."""
        ends = frame.can_id == SYNC_COB_ID
        if frame.error or frame.remote or frame.extended or not (ends or frame.can_id in self._ids):
            return False
        last = self._all[-1] if self._all else None
        if last is None or last.ended or any(frame.can_id == each.can_id for each in last.frames):
            last = _Answer(newest, [])
            self._all.append(last)
        last.frames.append(frame)
        last.ended = ends
        return True

    def give(self, samples: int, first: int) -> list[list[CanFrame]]:
        """The frames that were sent in answer to each of the `first` of `samples`; what is left is numbered anew."""
        places, before = list[int](), samples
        for answer in reversed(self._all):
            before = max(0, min(answer.newest, before - 1))
            places.append(before)
        given, left = [list[CanFrame]() for _ in range(first)], list[_Answer]()
        for place, answer in zip(reversed(places), self._all, strict=True):
            if place < first:
                given[place] += answer.frames
            else:
                answer.newest -= first
                left.append(answer)
        self._all = left
        return given


def rows_from_frames(
    frames: Iterable[CanFrame], io: VehicleIo, kind: Kind[Any], roll_filter: RollFilter, start_ns: int = 0
) -> Iterator[Frame]:
    """The samples that the daemon recorded, from the raw frames of a log that begins at `start_ns`.

    Reference, excitation and phase were never on the bus: they are NaN. If the log ends before the setpoints of the
    last sample, it has the previous setpoints.
    """
    io.reset(start_ns)
    roll_filter.reset()
    answers = _Answers(io)
    samples: list[tuple[RollState, Measurement]] = []

    def rows(first: int) -> Iterator[Frame]:
        for (attitude, drives), answer in zip(samples[:first], answers.give(len(samples), first), strict=True):
            for frame in answer:
                io.handle(frame)
            if drives.timestamp_ns:
                yield row(kind, attitude, drives, UNKNOWN, NAN)
        del samples[:first]

    for frame in frames:
        if samples and answers.take(frame, len(samples) - 1):
            continue
        sample = io.handle(frame)
        if sample is not None:
            samples.append((roll_filter.update(sample), kind.measure()))
            if len(samples) == 2 * HELD_BACK:
                yield from rows(HELD_BACK)
    yield from rows(len(samples))
