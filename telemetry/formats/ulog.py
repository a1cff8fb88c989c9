"""ULog of PX4 (pyulog, the extra `upright[ulog]`); https://docs.px4.io/main/en/dev_log/ulog_file_format.html."""

from __future__ import annotations

import io
import struct
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from upright.telemetry.errors import RecordingError
from upright.telemetry.formats.columns import counted, table_of
from upright.telemetry.tables.raw import Column, RawTable

HEADER = 16
"""Bytes before the first message."""
LONGEST = 65_536
"""Bytes of the longest message."""
AGAIN = 4
"""Reads without getting farther, for each byte of the longest message or of a shorter file: two, and as many again."""


def read(path: Path) -> Sequence[RawTable]:
    """A table for each topic and instance. Raises OSError, and what pyulog raises."""
    from pyulog import ULog

    log = ULog(_Ending(path))
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


class _Ending(io.BytesIO):
    """The bytes of a log. Where they are damaged, pyulog goes back to try each byte as the beginning of a message, and
    at the end of some files for ever. Raises RecordingError then."""

    def __init__(self, path: Path) -> None:
        content = path.read_bytes()
        super().__init__(content)
        self._path = path
        self._most = AGAIN * max(HEADER, min(len(content), LONGEST))
        self._farthest = 0
        self._again = 0

    def read(self, size: int | None = -1, /) -> bytes:
        data = super().read(size)
        place = self.tell()
        if place > self._farthest:
            self._farthest, self._again = place, 0
        self._again += 1
        if self._again > self._most:
            what = f"is damaged before byte {self._farthest}: no message ends there"
            raise RecordingError(str(self._path), "", what, remedy="Copy the file again from the vehicle.")
        return data


def _is_cut(path: Path) -> bool:
    """Whether the last message is not whole, by the sizes that the messages state."""
    content = path.read_bytes()
    place = HEADER
    while place + 3 <= len(content):
        place += 3 + int(struct.unpack_from("<H", content, place)[0])
    return place != len(content)
