"""Messages of topics as raw tables: each topic is one, with a clock of its own, and columns named as their path
(`/joint_states/joint1/position`).

Arrays of numbers beside an array of texts of the same length are named by these texts, as joints are; others are
numbered (`/gains/data[0]`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from telemetry.tables.raw import Column, RawTable

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
        for path, value in self._numbers("", message, ()):
            rows, values = self.columns.setdefault(path, ([], []))
            rows.append(row)
            values.append(value)

    def _numbers(self, path: str, value: Any, names: Sequence[str]) -> Iterator[tuple[str, float]]:
        """The numbers of a message by their paths; `names` are those that its arrays may be named by."""
        if isinstance(value, bool | int | float | np.number | np.bool_):
            yield path, float(value)
        elif isinstance(value, np.ndarray | list | tuple):
            yield from self._elements(path, value)
        elif (fields := _fields(value)) is not None:
            texts = [each for each in fields.values() if isinstance(each, list) and each and isinstance(each[0], str)]
            for name, each in fields.items():
                here = f"{path}/{name}" if path else name
                named = next((words for words in (*texts, names) if _is_array(each) and len(words) == len(each)), None)
                if not named or isinstance(each[0], str):
                    yield from self._numbers(here, each, texts[0] if texts else names)
                    continue
                for word, element in zip(named, each, strict=True):
                    yield from self._numbers(f"{path}/{word}/{name}" if path else f"{word}/{name}", element, ())

    def _elements(self, path: str, values: Any) -> Iterator[tuple[str, float]]:
        if len(values) > MOST:
            self.left_out.add(path)
            return
        for place, each in enumerate(values):
            yield from self._numbers(f"{path}[{place}]", each, ())

    def table(self, source: str, alone: bool) -> RawTable:
        """The topic as a table; its columns are named without it if it is `alone` in its file."""
        count = len(self.log_ns)
        time, said = self._time()
        columns = [Column("time", "timestamp_ns", "ns", time.astype(np.float64), time)]
        for path, (rows, values) in self.columns.items():
            whole = np.full(count, np.nan)
            whole[rows] = values
            heading = f"{self.name}/{path}"
            name = self.name if len(self.columns) == 1 and path in ALONE else path if alone else heading
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
    """All that a file of messages holds: its topics, what was said of it, and what it knows of itself."""

    source: str
    topics: dict[str, Topic] = field(default_factory=dict)
    said: list[str] = field(default_factory=list)
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
        """A table for each topic with numbers."""
        topics = [each for each in self.topics.values() if each.columns]
        said = [*self.said, *(f"{key}: {count} messages left out" for key, count in self._odd.items())]
        tables = [each.table(self.source, len(topics) == 1) for each in topics]
        return [
            RawTable(each.source, each.columns, each.lines, {}, self.metadata, (*said, *each.said), self.truncated)
            for each in tables
        ]


def _is_array(value: Any) -> bool:
    return isinstance(value, np.ndarray | list | tuple) and len(value) > 0


def _fields(value: Any) -> Mapping[str, Any] | None:
    if isinstance(value, Mapping):
        return value
    names = getattr(value, "__dataclass_fields__", None)
    return None if names is None else {name: getattr(value, name) for name in names if not name.startswith("__")}


def _stamp(message: Any) -> int | None:
    """ns of `header.stamp`, None if there is none."""
    header = (_fields(message) or {}).get("header")
    stamp = _fields((_fields(header) or {}).get("stamp")) or {}
    seconds = next((stamp[name] for name in SECONDS if name in stamp), None)
    part = next((stamp[name] for name in NANOSECONDS if name in stamp), None)
    if not (isinstance(seconds, int) and isinstance(part, int)):
        return None
    return seconds * 1_000_000_000 + part
