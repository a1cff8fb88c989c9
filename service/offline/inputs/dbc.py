"""The signals of a CAN log by a DBC file (Vector), as a recording: channels of any vehicle, in SI units.

cantools reads the DBC: the extra `upright[dbc]`. A channel is named after its signal, and after its message too where
two messages have a signal of that name. The samples are those of the message that comes most often; every other signal
has the value that was received last, NaN before its first.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from upright.service.offline.inputs.can_log import CanLog, open_log
from upright.telemetry.channels import Channel, ChannelTable
from upright.telemetry.errors import RecordingError
from upright.telemetry.recording import Recording
from upright.telemetry.samples import CanFrame
from upright.telemetry.tables.mapping import NOTHING, Said
from upright.telemetry.tables.raw import Column, RawTable
from upright.telemetry.tables.read import recordings
from upright.telemetry.tables.units import Unit, unit_of
from upright.telemetry.tables.wanted import Wanted

OTHERS = (".kcd", ".sym", ".arxml")
"""Suffixes of other formats that cantools reads as well."""


@dataclass(slots=True)
class _Signal:
    unit: str
    meaning: str
    times: list[int] = field(default_factory=list)
    values: list[float] = field(default_factory=list)


def read_signals(
    path: Path, database: Path, wanted: Sequence[Wanted] = (), user: Said = NOTHING
) -> Sequence[Recording]:
    """The signals of `database` in the CAN log at `path`. If channels are `wanted`, or the `user` says which they are,
    they are read as the columns of a table. Raises RecordingError like `signals`."""
    found = signals(open_log(path), database, path)
    return recordings([table_of(found)], wanted, user) if wanted or user != NOTHING else (found,)


def signals(log: CanLog, database: Path, source: Path) -> Recording:
    """The signals of `database`, a DBC, in the frames of a log.

    Raises:
        RecordingError: cantools is missing, the DBC cannot be read, or the log holds none of its messages.
    """
    messages = _messages(database)
    found: dict[tuple[str, str], _Signal] = {}
    received: dict[str, list[int]] = defaultdict(list)
    other: Counter[int] = Counter()
    undecoded: Counter[str] = Counter()
    for frame in log:
        if frame.error or frame.remote:
            continue
        message = messages.get((frame.can_id, frame.extended))
        if message is None:
            other[frame.can_id] += 1
        elif not _take(message, frame, found):
            undecoded[message.name] += 1
        else:
            received[message.name].append(frame.timestamp_ns)
    if not received:
        heard = ", ".join(f"{can_id:X}h" for can_id, _ in other.most_common(5)) or "none"
        known = ", ".join(f"{can_id:X}h" for can_id, _ in list(messages)[:5])
        raise RecordingError(
            str(source),
            "",
            f"holds no message of {database}: it has the ids {heard}, the DBC {known}",
            remedy="Name the DBC of this bus.",
        )
    notes = [log.truncated]
    notes += [f"{count} frames of {name} are too short for the DBC" for name, count in undecoded.items()]
    fastest = max(received, key=lambda name: len(received[name]))
    return _recording(found, received[fastest], str(source), "; ".join(filter(None, notes)))


def table_of(found: Recording) -> RawTable:
    """`signals` as a table, so that a model finds its channels in it as in any other."""
    stamps = found.timestamp_ns
    time = Column("time", "time", "ns", stamps.astype(np.float64), stamps, "date")
    columns = (Column(each.name, each.name, each.unit, found[each.name]) for each in found.channels)
    return RawTable(found.source, (time, *columns), np.arange(1, len(stamps) + 1), truncated=found.truncated)


def _messages(database: Path) -> dict[tuple[int, bool], Any]:
    """The messages of a DBC by id and whether that is extended."""
    try:
        import cantools
    except ModuleNotFoundError as error:
        raise RecordingError(
            str(database), "", f"needs the package {error.name}", remedy="pip install 'upright[dbc]'."
        ) from error
    try:
        kind = None if database.suffix.lower() in OTHERS else "dbc"
        read = cantools.database.load_file(str(database), database_format=kind, strict=False, prune_choices=False)
    except OSError as error:
        raise RecordingError(
            str(database), "", f"cannot be read: {error.strerror}", remedy="Check the path and its permissions."
        ) from error
    except Exception as error:  # cantools tries every format it knows, and raises what each of them does
        what = f"is no DBC that can be read: {str(error).splitlines()[0] if str(error) else type(error).__name__}"
        raise RecordingError(str(database), "", what, remedy="Export it again as a DBC.") from error
    messages = {(each.frame_id, each.is_extended_frame): each for each in getattr(read, "messages", [])}
    if not messages:
        raise RecordingError(str(database), "", "holds no messages", remedy="Name the DBC of this bus.")
    return messages


def _take(message: Any, frame: CanFrame, found: dict[tuple[str, str], _Signal]) -> bool:
    """Add the signals of a frame. False if it cannot be decoded."""
    try:
        values = message.decode(frame.data, decode_choices=False, allow_truncated=True)
    except (ValueError, KeyError, TypeError):
        return False
    except Exception as error:
        if type(error).__module__.startswith(("cantools", "bitstruct")):
            return False
        raise
    for name, value in values.items():
        key = (message.name, name)
        if key not in found:
            signal = message.get_signal_by_name(name)
            found[key] = _Signal(str(signal.unit or ""), str(signal.comment or f"{name} of {message.name}"))
        found[key].times.append(frame.timestamp_ns)
        found[key].values.append(float(value))
    return bool(values)


def _recording(found: dict[tuple[str, str], _Signal], times: Iterable[int], source: str, notes: str) -> Recording:
    instants = np.unique(np.fromiter(times, dtype=np.int64))
    often = Counter(name for _, name in found)
    channels, values = [], {}
    for (message, name), signal in found.items():
        written = unit_of(signal.unit or "1") or Unit(signal.unit, 1.0)
        called = name if often[name] == 1 else f"{message}.{name}"
        channels.append(Channel(called, written.si, signal.meaning))
        values[called] = written.factor * _held(signal, instants)
    return Recording(ChannelTable(channels), instants, values, truncated=notes, source=source)


def _held(signal: _Signal, instants: NDArray[np.int64]) -> NDArray[np.float64]:
    """The value received last at each instant, (n,); NaN before the first."""
    stamps = np.array(signal.times, dtype=np.int64)
    order = np.argsort(stamps, kind="stable")
    place = np.searchsorted(stamps[order], instants, side="right") - 1
    return np.where(place >= 0, np.array(signal.values)[order][np.maximum(place, 0)], np.nan)
