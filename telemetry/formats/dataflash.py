"""Dataflash logs of ArduPilot (pymavlink, the extra `upright[ardupilot]`).

A message that several instances send (`IMU`) is a topic for each of them (`/IMU[0]`). Units are those that the log
states in its FMTU messages.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np

from upright.telemetry.formats.columns import counted, table_of
from upright.telemetry.tables.raw import Column, RawTable

DESCRIPTION = ("FMT", "FMTU", "UNIT", "MULT")
"""Messages that describe the others."""
CLOCKS = {"TimeUS": "us", "TimeMS": "ms"}


def read(path: Path) -> Sequence[RawTable]:
    """A table for each message and instance. Raises OSError, and what pymavlink raises."""
    from pymavlink.DFReader import DFReader_binary

    found: dict[str, tuple[Any, list[dict[str, Any]]]] = {}
    end = 0
    with closing(DFReader_binary(str(path))) as log:
        while (message := log.recv_msg()) is not None:
            end = log.offset
            kind, fields = message.fmt, message.to_dict()
            if kind.name in DESCRIPTION:
                continue
            name = f"/{kind.name}"
            if kind.instance_field:
                name += f"[{fields[kind.instance_field]}]"
            found.setdefault(name, (kind, []))[1].append(fields)
        rest = log.data_len - end
    cut = f"the last {rest} bytes are no whole message: the file is read up to there" if rest else ""
    tables = [_table(str(path), name, kind, rows, cut) for name, (kind, rows) in found.items()]
    return [each for each in tables if each is not None]


def _table(source: str, topic: str, kind: Any, rows: Sequence[dict[str, Any]], cut: str) -> RawTable | None:
    clock = next((name for name in CLOCKS if name in kind.columns), "")
    if not clock:
        return None
    time = counted(np.array([row[clock] for row in rows], dtype=np.int64), CLOCKS[clock])
    columns = []
    for name in kind.columns:
        values = [row[name] for row in rows]
        if name != clock and all(isinstance(each, int | float) for each in values):
            path = f"{topic}/{name}"
            columns.append(Column(path, path, kind.get_unit(name), np.array(values, dtype=np.float64)))
    return table_of(source, time, columns, (), None, cut) if columns else None
