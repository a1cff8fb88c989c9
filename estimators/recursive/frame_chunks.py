"""From control cycles to gapless segments for a compiled model, a chunk at a time.

A cycle is used if every channel of the model is known and the vehicle is free of its supports, by the rules of
estimators.data.segments. The cuts between chunks depend on cycles alone, so they are the same in live, replayed and
simulated runs. A measured input is interpolated and may act earlier than its time stamp, so a chunk is complete when
the input is known that far beyond its last sample. For an input that acts later, earlier samples are included, even
those on a support or with an unknown output.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from operator import itemgetter

import numpy as np
from numpy.typing import NDArray

from upright.estimators.contract import Status
from upright.estimators.data.segments import LONGEST_GAP, SHORTEST, SUPPORT_MARGIN, DataError, reading
from upright.models.model import Model
from upright.models.segment import Segment
from upright.telemetry.channels import IDLE, ChannelTable
from upright.telemetry.samples import Frame

Array = NDArray[np.float64]

LISTENING = 25
"""Cycles from which the sampling period is estimated, before the first cycle is used."""
FEWEST = 25
"""Samples of a window, at least: fewer hardly determine more than its initial state."""
OLDEST = 0.1
"""Largest usable age of a sample of another device, s."""
EARLIER_NS = 1_000_000_000
"""ns: a cycle that is earlier than its predecessor by at least this is not late, but belongs to another recording."""
HISTORY = 0.1
"""s before a segment for which its inputs are kept: no lag of a command is estimated while the vehicle runs."""
FARTHEST = 0.1
"""Largest shift of an input by a delay without bounds, s."""


@dataclass(frozen=True, slots=True)
class Chunk:
    """Samples `first` to `last` of `segment`. Unless the chunk begins a gapless segment, sample `first` was the last of
    the previous chunk.

    `settled`: the model's settling time is over."""

    segment: Segment
    first: int
    last: int
    begins: bool
    settled: bool = True

    @property
    def rows(self) -> slice:
        """Samples that were in no previous chunk."""
        return slice(self.first if self.begins else self.first + 1, self.last + 1)

    def as_first(self) -> Chunk:
        """The chunk as the beginning of a gapless segment."""
        return replace(self, begins=True)


def join(chunks: Sequence[Chunk], most: int) -> Iterator[Chunk]:
    """The same samples in fewer chunks, each joined from up to `most` consecutive ones."""
    begin = 0
    for place in range(1, len(chunks) + 1):
        if place == len(chunks) or chunks[place].begins or place - begin == most:
            yield _joined(chunks[begin:place])
            begin = place


def _joined(chunks: Sequence[Chunk]) -> Chunk:
    head, tail = chunks[0], chunks[-1]
    if len(chunks) == 1:
        return head
    parts = [(head.segment, slice(0, head.last + 1))]
    parts += [(chunk.segment, chunk.rows) for chunk in chunks[1:]]
    parts += [(tail.segment, slice(tail.last + 1, None))]
    time, knots, inputs, measured = (
        np.concatenate([getattr(segment, name)[rows] for segment, rows in parts])
        for name in ("time", "knots", "inputs", "measured")
    )
    last = len(time) - len(tail.segment) + tail.last
    segment = Segment(time, knots, inputs, measured, head.segment.source)
    return Chunk(segment, head.first, last, head.begins, head.settled)


class FrameChunks:
    """Takes control cycles and returns a chunk of `rows` samples whenever one is complete.

    With `window` > 0 s a chunk is that long, and each is a segment of its own. `support` (rad) is the magnitude of the
    first joint's coordinate at which supports carry the vehicle. Raises DataError if a channel is not in the table.
    """

    def __init__(
        self, model: Model, channels: ChannelTable, *, support: float | None, rows: int, window: float = 0.0
    ) -> None:
        coordinate = model.joints[0].coordinate if model.joints and support is not None else ""
        ages = [each.age for each in model.inputs] + [each.age for each in model.outputs]
        channels_used = [each.name for each in model.inputs] + [each.name for each in model.outputs]
        names = list(dict.fromkeys((*channels_used, *filter(None, (coordinate, *ages)))))
        for name in names:
            if name not in channels.names:
                what = f"model {model.name} needs it; the channels are {', '.join(channels.names)}"
                remedy = "record it, or use a model that does without."
                raise DataError(Status.MISSING_CHANNEL, f"channel {name}", what, remedy=remedy)
        # The age of channels that are sampled with the cycle is a constant zero.
        self._pick = itemgetter(*(channels.index_of(name) for name in names))
        zero = len(names)
        self._coordinate = names.index(coordinate) if coordinate else zero
        self._free_angle = support - SUPPORT_MARGIN if coordinate and support is not None else math.inf
        self._inputs = [names.index(each.name) for each in model.inputs]
        self._usual = [(names.index(each.name), each.usual) for each in model.inputs if each.usual is not None]
        self._usual += [(names.index(age), 0.0) for age in {*ages} if age and channels[channels.index_of(age)].newer]
        self._readings = [reading(each) for each in model.outputs]
        self._outputs = [names.index(each.name) for each in model.outputs]
        places = [names.index(age) if age else zero for age in ages]
        self._input_ages, self._output_ages = places[: len(model.inputs)], places[len(model.inputs) :]
        self._ages = sorted({place for place in places if place != zero})
        self._phase = channels.index_of("phase") if "phase" in channels.names else None
        self._reach = _reach(model)
        self._late = any(each.delays for each in model.inputs)
        self._settling = model.settling
        self._chunk = rows
        self._window = window
        self.reset()

    def reset(self) -> None:
        """Return to the state before the first cycle."""
        self.cycles = 0
        """Cycles seen so far."""
        self.period = 0.0
        """Sampling period, s; 0 until it is known."""
        self._early: list[int] = []
        self._start = self._last = 0
        self._ran = False  # an experiment
        self.settled = not self._settling
        """Whether the model's settling time is over."""
        self._settled_at = math.nan  # s; not known before the first free sample
        self._known = -math.inf  # s until which the inputs are known, a sample beyond included
        self._end_segment()

    def update(self, frame: Frame) -> Chunk | None:
        """The chunk that this cycle completes, if any. Raises nothing: unusable cycles are skipped."""
        stamp = frame.timestamp_ns
        if self.cycles and stamp <= self._last:
            if self._last - stamp < EARLIER_NS:
                return None
            self._end_segment()
            self._start, self._last = stamp, stamp - 1
        self.cycles += 1
        before, self._last = self._last, stamp
        if not self.period:
            self._listen(stamp)
            return None
        if stamp - before > self._longest_gap:
            self._end_segment()
        row = (*self._pick(frame.values), 0.0)
        total = sum(row)
        if total != total and self._usual:
            row = self._with_usual(row)
            total = sum(row)
        oldest = 0.0
        for place in self._ages:
            age = row[place]
            if not -OLDEST <= age <= OLDEST:
                self._end_segment()
                return None
            oldest = max(oldest, age)
        time = (stamp - self._start) * 1e-9
        let_go = False
        if self._phase is not None:
            phase = frame.values[self._phase]
            self._ran |= phase > IDLE
            let_go = self._ran and phase == IDLE
        # NaN, infinite, on a support, or falling
        if total - total != 0.0 or abs(row[self._coordinate]) >= self._free_angle or let_go:
            self._wait(time, row)
            return None
        if not self.settled:
            self._settle(time)
        self._times.append(time)
        self._rows.append(row)
        known = self._known
        self._known = time - oldest
        if len(self._times) < self._wanted or known < self._times[self._first + self._length] + self._reach:
            return None
        return self._cut()

    def _wait(self, time: float, row: tuple[float, ...]) -> None:
        """Take a sample outside of any segment: its inputs may still act on the first samples of the next one."""
        if not self._late or not all(math.isfinite(row[place]) for place in self._inputs):
            self._end_segment()
            return
        times, rows = self._latest(time + self.period)
        self._end_segment([*times, time], [*rows, row])

    def _settle(self, time: float) -> None:
        """Take a free sample before the model's settling time is over; the first one after that time begins a
        segment."""
        if math.isnan(self._settled_at):
            self._settled_at = time + self._settling
        elif time >= self._settled_at:
            self.settled = True
            self._end_segment(*self._latest(time))

    def _latest(self, time: float) -> tuple[list[float], list[tuple[float, ...]]]:
        """Times and values of the samples whose inputs may still act at `time`, s."""
        begin = bisect_right(self._times, time - HISTORY) if self._late else len(self._times)
        return self._times[begin:], self._rows[begin:]

    def _with_usual(self, row: tuple[float, ...]) -> tuple[float, ...]:
        """The sample with the usual value of channels that no device reported."""
        whole = list(row)
        for place, usual in self._usual:
            if math.isnan(whole[place]):
                whole[place] = usual
        return tuple(whole)

    def _listen(self, stamp: int) -> None:
        if not self._early:
            self._start = stamp
        self._early.append(stamp)
        if len(self._early) == LISTENING:
            spacing = sorted(later - one for one, later in zip(self._early, self._early[1:], strict=False))
            self.period = spacing[len(spacing) // 2] * 1e-9
            self._longest_gap = LONGEST_GAP * spacing[len(spacing) // 2]
            if self._window:
                self._chunk = max(FEWEST, round(self._window / self.period))
            self._end_segment()

    def _end_segment(self, times: list[float] | None = None, rows: list[tuple[float, ...]] | None = None) -> None:
        """End the segment. The next one may begin with samples (`times`, `rows`) of which only the inputs are used."""
        self._times: list[float] = times or []
        self._rows: list[tuple[float, ...]] = rows or []
        self._known = -math.inf
        # The value of a delayed input before the first sample of all is unknown, so that sample only provides it.
        self._first = max(len(self._times), int(self._late))
        self._begins = True
        self._length: int = self._chunk - 1 if self._window else self._chunk
        self._wanted: int = max(SHORTEST, self._first + self._length + 1)

    def _cut(self) -> Chunk:
        first, last = self._first, self._first + self._length
        time = np.array(self._times)
        table = np.array(self._rows)
        measured = np.take(table, self._outputs, axis=1)
        for column, age in enumerate(self._output_ages):
            if age in self._ages:
                measured[:, column] = self._readings[column](time, time - table[:, age], measured[:, column])
        knots = time[:, None] - np.take(table, self._input_ages, axis=1)
        inputs = np.take(table, self._inputs, axis=1)
        segment = Segment(time, knots, inputs, measured, "live")
        chunk = Chunk(segment, first, last, self._begins, self.settled)
        begin = last + 1 if self._window else last
        # Keep what is needed before the next chunk begins: a curve between two samples needs their neighbours.
        newest = max(0.0, -float(np.min(table[:, self._ages], initial=0.0)))
        kept = max(0, int(np.searchsorted(time, time[last] - self._reach - newest)) - 2)
        del self._times[:kept], self._rows[:kept]
        self._first = begin - kept
        self._begins = bool(self._window)
        self._wanted = self._first + self._length + 1
        return chunk


def _reach(model: Model) -> float:
    """Largest shift of an input by delays, s."""
    bounds = [0.0]
    names = {delay for each in model.inputs for delay in each.delays}
    names |= {attached.qualified(attached.effect.delay) for attached in model.effects if attached.effect.delay}
    for name in names:
        parameter = model.parameter(name)
        bounds += [abs(bound) if math.isfinite(bound) else FARTHEST for bound in (parameter.lower, parameter.upper)]
    return max(bounds)
