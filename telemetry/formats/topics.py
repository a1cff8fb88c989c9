"""Messages of topics as raw tables: each topic is one, with a clock of its own, and columns named as their path
(`/joint_states/joint1/position`).

Arrays of numbers beside an array of texts of the same length are named by these texts, as joints are; others are
numbered (`/gains/data[0]`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from upright.telemetry.errors import RecordingError
from upright.telemetry.tables.raw import Column, RawTable

Decode = Callable[[bytes], Any]
"""A decoder of messages; it raises where one is damaged."""
MOST = 64
"""Elements up to which an array is channels; longer ones are images, scans and point clouds."""
ALONE = ("data", "value")
"""Fields that stand for their topic, if it has no other."""
SECONDS, NANOSECONDS = ("sec", "secs"), ("nanosec", "nsec", "nsecs")


@dataclass(slots=True)
class Topic:
    """The messages of a topic so far: `log_ns` when each was logged, `stamp_ns` those of their headers, by column the
    rows and their values. `units` are those of columns that state one."""

    name: str
    log_ns: list[int] = field(default_factory=list)
    stamp_ns: list[int] = field(default_factory=list)
    columns: dict[str, tuple[list[int], list[float]]] = field(default_factory=dict)
    units: Mapping[str, str] = field(default_factory=dict)
    left_out: set[str] = field(default_factory=set)

    def add(self, log_ns: int, message: Any) -> None:
        """A message: a mapping, or an object with the fields of a dataclass."""
        row = len(self.log_ns)
        self.log_ns.append(log_ns)
        stamp = _stamp(message)
        if stamp is not None:
            self.stamp_ns.append(stamp)
        found: list[tuple[str, float]] = []
        self._collect("", message, (), found)
        for path, value in found:
            rows, values = self.columns.setdefault(path, ([], []))
            rows.append(row)
            values.append(value)

    def _collect(self, path: str, value: Any, names: Sequence[str], found: list[tuple[str, float]]) -> None:
        """The numbers of a message by their paths; `names` are those that its arrays may be named by."""
        if isinstance(value, float | int | np.number | np.bool_):
            found.append((path, float(value)))
        elif isinstance(value, np.ndarray | list | tuple):
            if len(value) > MOST:
                self.left_out.add(path)
                return
            for place, each in enumerate(value):
                self._collect(f"{path}[{place}]", each, (), found)
        elif not isinstance(value, str) and (fields := _fields(value)) is not None:
            own = next((each for each in fields.values() if _is_array(each) and isinstance(each[0], str)), names)
            before = f"{path}/" if path else ""
            for name, each in fields.items():
                if own and _is_array(each) and len(each) == len(own) and not isinstance(each[0], str):
                    for word, element in zip(own, each, strict=True):
                        self._collect(f"{before}{word}/{name}", element, (), found)
                else:
                    self._collect(f"{before}{name}", each, own, found)

    def table(self, source: str, alone: bool) -> RawTable:
        """The topic as a table; its columns are named without it if it is `alone` in its file."""
        count = len(self.log_ns)
        time, said = self._time()
        columns = [Column("time", "timestamp_ns", "ns", time.astype(np.float64), time)]
        for path, (rows, values) in self.columns.items():
            whole = np.full(count, np.nan)
            whole[rows] = values
            heading = f"{self.name}/{path}" if path else self.name
            name = self.name if len(self.columns) == 1 and path in ALONE else path if alone and path else heading
            columns.append(Column(heading, name, self.units.get(path, ""), whole))
        if self.left_out:
            said.append(
                f"{self.name}: arrays of more than {MOST} elements left out: {', '.join(sorted(self.left_out))}"
            )
        return RawTable(source, tuple(columns), np.arange(1, count + 1, dtype=np.int64), said=tuple(said))

    def _time(self) -> tuple[NDArray[np.int64], list[str]]:
        """The stamps of the headers, if all messages have one, they are set, and they are of the clock of the log."""
        log = np.array(self.log_ns, dtype=np.int64)
        if len(self.stamp_ns) != len(log) or not any(self.stamp_ns):
            return log, [f"{self.name}: time when each message was logged"]
        stamps = np.array(self.stamp_ns, dtype=np.int64)
        if np.max(np.abs(stamps - log)) > np.ptp(log) or np.any(np.diff(stamps) < 0):
            return log, [f"{self.name}: time when each message was logged, since header.stamp is of another clock"]
        for part in (*SECONDS, *NANOSECONDS):
            self.columns.pop(f"header/stamp/{part}", None)
        return stamps, [f"{self.name}: time of header.stamp"]


@dataclass(slots=True)
class Log:
    """All that a file of messages holds: its topics, and what it knows of itself."""

    source: str
    topics: dict[str, Topic] = field(default_factory=dict)
    metadata: dict[str, str] = field(default_factory=dict)
    truncated: str = ""
    _odd: dict[str, int] = field(default_factory=dict)

    def topic(self, name: str) -> Topic:
        """The topic of that name, a new one if there is none."""
        path = f"/{name.lstrip('/')}"
        return self.topics.setdefault(path, Topic(path))

    def add(self, name: str, log_ns: int, data: bytes, decode: Decode | str) -> None:
        """A message of topic `name` in its encoding. One without a decoder, or with a text why there is none, and one
        that is damaged are left out and counted."""
        why = decode if isinstance(decode, str) else ""
        try:
            message = None if isinstance(decode, str) else decode(data)
        except Exception as error:  # the packages of encodings have no common one
            why = f"damaged ({type(error).__name__})"
        if why:
            self._odd[f"{name}: {why}"] = self._odd.get(f"{name}: {why}", 0) + 1
        else:
            self.topic(name).add(log_ns, message)

    def tables(self) -> Sequence[RawTable]:
        """A table for each topic with numbers. Raises RecordingError if no message could be read."""
        topics = [each for each in self.topics.values() if each.columns]
        said = [f"{key}: {count} messages left out" for key, count in self._odd.items()]
        if said and not topics:
            remedy = "Record messages in JSON or of ROS, or export them as CSV, with PlotJuggler for example."
            raise RecordingError(
                self.source, "", f"holds no message that can be read: {'; '.join(said)}", remedy=remedy
            )
        tables = [each.table(self.source, len(topics) == 1) for each in topics]
        return [
            RawTable(each.source, each.columns, each.lines, {}, self.metadata, (*said, *each.said), self.truncated)
            for each in tables
        ]


def _is_array(value: Any) -> bool:
    return isinstance(value, np.ndarray | list | tuple) and len(value) > 0


def _fields(value: Any) -> Mapping[str, Any] | None:
    names = getattr(value, "__dataclass_fields__", None)
    if names is not None:
        return {name: getattr(value, name) for name in names if not name.startswith("__")}
    return value if isinstance(value, Mapping) else None


def _stamp(message: Any) -> int | None:
    """ns of `header.stamp`, None if there is none."""
    header = message.get("header") if isinstance(message, Mapping) else getattr(message, "header", None)
    stamp = _fields((_fields(header) or {}).get("stamp")) or {}
    seconds = next((stamp[name] for name in SECONDS if name in stamp), None)
    part = next((stamp[name] for name in NANOSECONDS if name in stamp), None)
    if not (isinstance(seconds, int) and isinstance(part, int)):
        return None
    return seconds * 1_000_000_000 + part
