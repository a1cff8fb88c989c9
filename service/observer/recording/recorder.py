"""The recorder: writes an experiment to files that are readable even after a crash.

`STEM.arrow` gets all control cycles from the agreed start to the agreed end, in one batch per second, each on the disk
before the next; `STEM.log` gets the raw frames, if no separate process logs them; `STEM.estimates.json` gets the final
results and the live diagnosis.
Nothing here awaits: `write` may take long and is called in a thread, while the event loop adds further cycles.
"""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import numpy as np

from upright.service.whole_file import write_whole
from upright.telemetry.arrow_file import ArrowStreamWriter
from upright.telemetry.candump import format_frames
from upright.telemetry.channels import ChannelTable
from upright.telemetry.samples import CanFrame, Frame

NEVER_NS = 1 << 62


@dataclass(frozen=True, slots=True)
class Batch:
    """The data to be written next."""

    frames: list[Frame]
    can_frames: list[CanFrame]


class Recorder:
    """One recording. `stem` is its path without a suffix; `raw_buses` names the buses of raw frames to log, if any.

    Raises OSError if the files cannot be created.
    """

    def __init__(
        self,
        stem: Path,
        channels: ChannelTable,
        start_ns: int,
        metadata: Mapping[str, str],
        raw_buses: tuple[str, ...] = (),
    ) -> None:
        self.stem = stem
        self.path = Path(f"{stem}.arrow")
        self.rows = 0
        self.end_ns = NEVER_NS
        self.raw_end_ns = NEVER_NS
        self._start_ns = start_ns
        self._last_ns = start_ns - 1
        self._seen_ns = self._seen_can_ns = 0
        self._broken = False
        self._frames: list[Frame] = []
        self._can_frames: list[CanFrame] = []
        self._raw_buses = raw_buses
        self._raw_log: IO[str] | None = None
        stem.parent.mkdir(parents=True, exist_ok=True)
        self._stream = ArrowStreamWriter(self.path, channels, {**metadata, "start_ns": str(start_ns)})
        if raw_buses:
            self._raw_log = open(f"{stem}.log", "x", encoding="ascii")  # noqa: SIM115

    def add(self, frames: list[Frame]) -> list[Frame]:
        """Take control cycles, and return those that belong to the recording.

        A cycle that is not later than the previous one is left out: time is monotonic in a recording, even if a clock
        was set back.
        """
        taken = []
        self._seen_ns = frames[-1].timestamp_ns
        for frame in frames:
            if self._last_ns < frame.timestamp_ns <= self.end_ns:
                self._last_ns = frame.timestamp_ns
                taken.append(frame)
        self._frames += taken
        return taken

    def add_can(self, frames: list[CanFrame]) -> None:
        """Take raw frames."""
        self._seen_can_ns = frames[-1].timestamp_ns
        self._can_frames += [frame for frame in frames if self._start_ns <= frame.timestamp_ns <= self.raw_end_ns]

    @property
    def complete(self) -> bool:
        """Whether everything up to the agreed end has been received."""
        return self._seen_ns > self.end_ns and (self._raw_log is None or self._seen_can_ns > self.raw_end_ns)

    def take(self) -> Batch:
        """The data collected since the last call, for `write`."""
        batch = Batch(self._frames, self._can_frames)
        self._frames, self._can_frames = [], []
        return batch

    def write(self, batch: Batch) -> None:
        """Write a batch to the disk. One call at a time. Raises OSError; after that nothing is written any more."""
        if self._broken:
            return
        frames = batch.frames
        try:
            if frames:
                timestamp_ns = np.array([frame.timestamp_ns for frame in frames], dtype=np.int64)
                self._stream.append(timestamp_ns, np.array([frame.values for frame in frames], dtype=np.float64))
                self.rows += len(frames)
            if batch.can_frames and self._raw_log is not None:
                self._raw_log.write(format_frames(batch.can_frames, self._raw_buses))
                self._raw_log.flush()
                os.fsync(self._raw_log.fileno())
        except OSError:
            self._broken = True
            raise

    def finish(
        self, metadata: Mapping[str, str], estimates: Mapping[str, Any], diagnosis: Mapping[str, Any] | None = None
    ) -> None:
        """Write the rest, the final metadata and the final results. Raises OSError."""
        try:
            self.write(self.take())
        finally:
            if self._raw_log is not None:
                self._raw_log.close()
            self._stream.close(metadata)
        document = {"recording": self.path.name, "methods": estimates, "diagnosis": diagnosis}
        write_whole(Path(f"{self.stem}.estimates.json"), json.dumps(document, indent=2) + "\n")
