"""A recording: the channels of one experiment over time, in SI units, with their origin as metadata. telemetry.storage
reads and writes its files."""

from __future__ import annotations

import difflib
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Self

import numpy as np
from numpy.typing import NDArray

from upright.telemetry.channels import STEEPEST, Channel, ChannelTable
from upright.telemetry.errors import RecordingError
from upright.telemetry.options import assumed
from upright.telemetry.samples import Frame
from upright.telemetry.vehicle_modules import each_with

FARTHEST = 1 << 62
"""ns before or after 1970, until the year 2116: differences of two such times are exact."""


@dataclass(frozen=True, slots=True)
class Recording:
    """Channels over time.

    `timestamp_ns` int64 (n,), strictly rising; `values` float64 (n,) by channel name, NaN where a value was not known.
    `metadata` is what the writer knew (vehicle, kind, experiment, parameters, ...). `truncated` states what could be
    read of a file that was cut off; it is empty for a complete file. `source` names the file in errors. `stamped_ns`
    int64 (n,) are the time stamps that the controller had, if these are not the instants of the samples
    (telemetry.clock). `assumed` states what was assumed to read a table that others wrote (telemetry.tables), and
    `settled` are its channels whose unit the user stated.

    Raises RecordingError if columns differ in length, time does not rise, or an angle cannot be in radians.
    """

    channels: ChannelTable
    timestamp_ns: NDArray[np.int64]
    values: Mapping[str, NDArray[np.float64]]
    metadata: Mapping[str, str] = field(default_factory=dict)
    truncated: str = ""
    source: str = "recording"
    stamped_ns: NDArray[np.int64] | None = None
    assumed: tuple[str, ...] = ()
    settled: frozenset[str] = frozenset()

    def __post_init__(self) -> None:
        if len(self.timestamp_ns) == 0:
            raise RecordingError(self.source, "", "holds no rows", remedy="Record again, for longer.")
        if not self.channels.names:
            raise RecordingError(self.source, "", "holds no channels", remedy="Record again, or add some columns.")
        for name in self.channels.names:
            if self.values[name].shape != self.timestamp_ns.shape:
                raise RecordingError(
                    self.source,
                    name,
                    f"has {len(self.values[name])} values for {len(self.timestamp_ns)} instants",
                    remedy="Give every column the same length.",
                )
        first, last = int(self.timestamp_ns.min()), int(self.timestamp_ns.max())
        if max(-first, last) > FARTHEST:
            what = f"goes from {first * 1e-9:.3g} to {last * 1e-9:.3g} s, which are no times of this century"
            raise RecordingError(self.source, "time", what, remedy="Write the time in s, or as Unix time in ns.")
        backwards = np.flatnonzero(np.diff(self.timestamp_ns) <= 0)
        if len(backwards):
            raise RecordingError(
                self.source,
                "time",
                f"does not rise at row {backwards[0] + 2}",
                remedy="Sort the rows by time and leave out repeated ones.",
            )
        for channel in self.channels:
            if not channel.leans:
                continue
            largest = float(np.nanmax(np.abs(self.values[channel.name]), initial=0.0))
            if largest > STEEPEST:
                raise RecordingError(
                    self.source,
                    channel.name,
                    f"reaches {largest:.3g}, which cannot be {channel.unit}",
                    remedy=f"Recordings are in SI units; if it is in degrees: {assumed({channel.name: 'deg'})}.",
                )

    @property
    def time(self) -> NDArray[np.float64]:
        """s since the first sample, (n,)."""
        return np.asarray((self.timestamp_ns - self.timestamp_ns[0]) * 1e-9, dtype=np.float64)

    @property
    def stamped(self) -> NDArray[np.float64]:
        """s since the first time stamp that the controller had, (n,)."""
        stamps = self.timestamp_ns if self.stamped_ns is None else self.stamped_ns
        return np.asarray((stamps - stamps[0]) * 1e-9, dtype=np.float64)

    @property
    def duration(self) -> float:
        """s from the first sample to the last."""
        return float(self.timestamp_ns[-1] - self.timestamp_ns[0]) * 1e-9

    @property
    def rate(self) -> float:
        """Samples per second, from the median spacing; 0 for a single sample."""
        return float(1e9 / np.median(np.diff(self.timestamp_ns))) if len(self.timestamp_ns) > 1 else 0.0

    def __len__(self) -> int:
        return len(self.timestamp_ns)

    def __getitem__(self, name: str) -> NDArray[np.float64]:
        """Channel `name`, (n,). Raises RecordingError, which lists the available channels."""
        self.require(name)
        return self.values[name]

    def require(self, *names: str, finite: bool = False) -> None:
        """Raises RecordingError for the first of `names` that is missing or, with `finite`, has unknown values."""
        for name in names:
            if name not in self.values:
                near = difflib.get_close_matches(name, self.channels.names, n=1)
                raise RecordingError(
                    self.source,
                    name,
                    f"is missing; there are {', '.join(self.channels.names)}",
                    remedy=f"Is it {near[0]!r}? Rename the column." if near else "Add the channel, in SI units.",
                )
            unknown = np.flatnonzero(~np.isfinite(self.values[name]))
            if finite and len(unknown):
                raise RecordingError(
                    self.source,
                    name,
                    f"has {len(unknown)} values that are not numbers, the first in row {unknown[0] + 1}",
                    remedy="Leave these rows out.",
                )

    def between(self, begin: float = 0.0, end: float = math.inf) -> Self:
        """The samples from `begin` to `end`, s since the first. Raises RecordingError if there are fewer than two."""
        chosen = (self.time - self.time[0] >= begin) & (self.time - self.time[0] <= end)
        if np.count_nonzero(chosen) < 2:
            span = float(self.time[-1] - self.time[0])
            what = f"has no rows from {begin:g} to {end:g} s; it lasts {span:.1f} s"
            raise RecordingError(self.source, "", what, remedy="Choose a part that exists.")
        values = {name: column[chosen] for name, column in self.values.items()}
        stamped = None if self.stamped_ns is None else self.stamped_ns[chosen]
        return replace(self, timestamp_ns=self.timestamp_ns[chosen], values=values, stamped_ns=stamped)

    def frames(self, channels: ChannelTable | None = None) -> Iterator[Frame]:
        """Sample by sample, as the estimators take it, in the order of `channels` (those of the recording by default).

        A channel that older recordings lack is not known (NaN) there. Raises RecordingError if another is missing.
        """
        table = channels or self.channels
        self.require(*(each.name for each in table if not each.newer))
        unknown = [math.nan] * len(self)
        columns = [self.values[name].tolist() if name in self.values else unknown for name in table.names]
        for timestamp_ns, row in zip(self.timestamp_ns.tolist(), zip(*columns, strict=True), strict=True):
            yield Frame(timestamp_ns, row)


def describe(names: Mapping[str, str]) -> ChannelTable:
    """The channel table of columns `names`, name to unit ("" if the file states none); known ones get their meaning."""
    known = {channel.name: channel for module in each_with("channels").values() for channel in module.CHANNELS}
    return ChannelTable(
        known[name] if name in known and unit in ("", known[name].unit) else Channel(name, unit, "")
        for name, unit in names.items()
    )
