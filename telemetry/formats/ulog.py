"""ULog of PX4 (pyulog, the extra `upright[ulog]`); https://docs.px4.io/main/en/dev_log/ulog_file_format.html."""

from __future__ import annotations

import struct
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from upright.telemetry.formats.columns import counted, table_of
from upright.telemetry.tables.raw import Column, RawTable

HEADER = 16
"""Bytes before the first message."""


def read(path: Path) -> Sequence[RawTable]:
    """A table for each topic and instance. Raises OSError, and what pyulog raises."""
    from pyulog import ULog

    log = ULog(str(path))
    metadata = {key: value for key, value in log.msg_info_dict.items() if isinstance(value, str)}
    said = [f"{len(log.dropouts)} dropouts of the logger"] if log.dropouts else []
    if log.file_corruption:
        said.append("damaged messages left out")
    truncated = "the file ends in the middle of a message: it is read up to there" if _is_cut(path) else ""
    instances = Counter(each.name for each in log.data_list)
    tables = []
    for each in log.data_list:
        topic = f"/{each.name}[{each.multi_id}]" if instances[each.name] > 1 else f"/{each.name}"
        if "timestamp" not in each.data or not len(each.data["timestamp"]):
            continue
        columns = [
            Column(f"{topic}/{name}", f"{topic}/{name}", "", np.asarray(values, dtype=np.float64))
            for name, values in each.data.items()
            if name != "timestamp"
        ]
        tables.append(table_of(str(path), counted(each.data["timestamp"], "us"), columns, said, metadata, truncated))
    return tables


def _is_cut(path: Path) -> bool:
    """Whether the last message is not whole, by the sizes that the messages state."""
    content = path.read_bytes()
    place = HEADER
    while place + 3 <= len(content):
        place += 3 + int(struct.unpack_from("<H", content, place)[0])
    return place != len(content)
