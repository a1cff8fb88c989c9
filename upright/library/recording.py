"""Recordings: read from a file, or made of a table."""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping
from dataclasses import fields
from os import PathLike, fspath
from pathlib import Path
from typing import TYPE_CHECKING, Any

from upright.library.layers.recordings import (
    Recorded,
    Stated,
    in_python,
    longest,
    read,
    recordings,
    said_of,
    statements,
    table_of_frame,
)
from upright.library.shown import frame_of

if TYPE_CHECKING:
    import pandas

    from upright.library.layers.pictures import Picture
    from upright.library.layers.recordings import Source
    from upright.library.layers.results import GreyBox, VehicleFile


class RecordingWarning(UserWarning):
    """A recording can be used, but has something unusual: it was cut off, or the vehicle falls in it."""


class Recording(Recorded):
    """Channels over time, in SI units.

    `recording["angle"]` is a channel, float64 (n,), NaN where it is not known; `time` (n,) is in s since the first
    sample, `rate` in Hz, `duration` in s; `channels` have names and units, `metadata` is what the recorder knew.
    `between(begin, end)` is a part of it, s.
    """

    __slots__ = ()

    @classmethod
    @in_python()
    def from_frame(
        cls,
        frame: Any,
        *,
        units: Mapping[str, str] | None = None,
        assume: Mapping[str, Stated] | None = None,
        metadata: Mapping[str, str] | None = None,
        source: str = "table",
    ) -> Recording:
        """From a table of pandas or polars, or a mapping of names to arrays: `time` in s or dates, and channels in SI.

        `units` of columns, by name: `time` in ms, a channel in degrees; `assume` as for `load`. An index of dates or
        durations is the time, if no column is. What a table of a file may have, this one may have, too, and is said in
        `assumed`: columns of text are left out; rows that repeat, or are out of order, are put right; what is infinite
        is not known (NaN).
        `source` is its name in messages. Raises RecordingError, with the column and the remedy: there is no `time`, no
        channel or no row; a column has another length or shape; a unit is of no column.
        """
        stated = units or {}
        table = table_of_frame(frame, stated, metadata or {}, source)
        time = f"time=time:{stated['time']}" if "time" in stated else "time=time"
        user = said_of([time], statements(assume))
        return cls.of(longest(recordings([table], user=user)))

    @classmethod
    def of(cls, recorded: Recorded) -> Recording:
        """The same recording, as this class."""
        return cls(**{field.name: getattr(recorded, field.name) for field in fields(recorded)})

    def to_frame(self) -> pandas.DataFrame:
        """`time` (s) and the channels as a table of pandas. Raises MissingPackage."""
        return frame_of({"time": self.time} | {name: self[name] for name in self.channels.names})

    def plot(self, *channels: str) -> Picture:
        """The channels over time, by default those that change, as a figure of matplotlib."""
        from upright.library.layers.pictures import recording_figure

        return recording_figure(self, channels)

    def __str__(self) -> str:
        what = ", ".join(f"{each.name} ({each.unit})" if each.unit else each.name for each in self.channels)
        return f"{self.source}: {self.duration:.4g} s, {len(self)} samples at {self.rate:.4g} Hz; {what}"

    __repr__ = __str__


@in_python()
def load(
    path: str | PathLike[str],
    *,
    vehicle: str | PathLike[str] | None = None,
    model: str | PathLike[str] | None = None,
    dbc: str | PathLike[str] | None = None,
    columns: Mapping[str, str] | None = None,
    assume: Mapping[str, Stated] | None = None,
    begin: float = 0.0,
    end: float = math.inf,
) -> Recording:
    """Read a recording: .arrow, .parquet, a table or log of any origin, or a CAN log of a `vehicle` or with a `dbc`.

    `vehicle`: a shipped one or a vehicle file, for a CAN log of it; a table of that vehicle from elsewhere is completed
    by what is usual. `dbc`: a DBC file, whose signals in a CAN log become channels in SI units. `model`: its channels
    and its table [columns] say how a table, or the signals of a DBC, are read. `columns` gives the column or signal of
    a channel and its unit, as in {"angle": "pos:deg"}; `assume` what they do not state, as in {"angle": "deg"} or
    {"angle": ["deg", "wrapped"]}. What was assumed besides is in `assumed`. `begin`, `end`: the part that is used, s.
    Time stamps that jitter although the samples do not are replaced by those of the sampling clock. What is unusual is
    a RecordingWarning.
    Raises RecordingError, which names the file, the channel or line, and the remedy.
    """
    known = None if vehicle is None else _file(vehicle)
    needed, written = (None, {}) if model is None else _needed(model)
    user = said_of(statements(columns), statements(assume), written)
    found, notes = read(Path(path), known, needed, user, None if dbc is None else Path(dbc))
    for note in notes:
        warnings.warn(f"{path}: {note}", RecordingWarning, stacklevel=3)  # behind the decorator
    return Recording.of(found).between(begin, end)


def _file(vehicle: str | PathLike[str]) -> VehicleFile:
    from upright.library.layers.results import load_vehicle

    return load_vehicle(fspath(vehicle))


def _needed(model: str | PathLike[str]) -> tuple[list[GreyBox], dict[str, Source]]:
    """The model of which a table is needed, and its table [columns]."""
    from upright.library.layers.results import columns, identified_model

    return [identified_model(fspath(model), None)], columns(fspath(model))
