"""Arrays as columns of a table with a clock of its own."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from upright.telemetry.tables.raw import Column, RawTable

NANOSECONDS = {"s": 1_000_000_000, "ms": 1_000_000, "us": 1000, "ns": 1}


def counted(ticks: NDArray[np.integer], unit: str) -> Column:
    """A clock that counts in `unit`, (n,)."""
    ns = ticks.astype(np.int64) * NANOSECONDS[unit]
    return Column("time", "timestamp_ns", "ns", ns.astype(np.float64), ns)


def seconds(values: NDArray[np.floating], unit: str = "s") -> Column:
    """A clock in seconds, (n,), or in another `unit` that its file states."""
    return Column("time", "time", unit, np.asarray(values, dtype=np.float64))


def table_of(
    source: str,
    clock: Column,
    columns: Sequence[Column],
    said: Sequence[str] = (),
    metadata: Mapping[str, str] | None = None,
    truncated: str = "",
) -> RawTable:
    """The table of `clock` and `columns`, all (n,)."""
    lines = np.arange(1, len(clock.values) + 1, dtype=np.int64)
    return RawTable(source, (clock, *columns), lines, {}, dict(metadata or {}), tuple(said), truncated)
