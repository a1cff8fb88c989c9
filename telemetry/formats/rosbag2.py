"""Bags of ROS 2: a folder of MCAP or SQLite files, or one of these (rosbags, the extra `upright[ros]`).

The tables of a SQLite file are those of rosbag2_storage_sqlite3. They are read in their order, without metadata.yaml,
so that a bag that was cut off is read as well. Files and messages may be compressed by zstd.
"""

from __future__ import annotations

import re
import sqlite3
import struct
from collections.abc import Iterator, Sequence
from contextlib import closing
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from upright.telemetry.errors import RecordingError
from upright.telemetry.formats import mcap
from upright.telemetry.formats.ros_messages import ros2
from upright.telemetry.formats.topics import Decode, Log
from upright.telemetry.tables.raw import RawTable

SUFFIXES = (".db3", ".mcap")
PACKED = ".zstd"
"""What compressed files end with besides."""
ZSTD = b"\x28\xb5\x2f\xfd"
"""What compressed messages begin with; those in CDR begin with a zero."""


def read(path: Path) -> Sequence[RawTable]:
    """A table for each topic. Raises RecordingError, OSError, and what its packages raise."""
    log = Log(str(path))
    with TemporaryDirectory() as folder:
        for each in _files(path):
            file = _unpacked(each, Path(folder)) if each.suffix == PACKED else each
            if file.suffix == ".mcap":
                mcap.read_into(log, file)
            else:
                _read_sqlite(log, file)
    return log.tables()


def _files(path: Path) -> Sequence[Path]:
    """The files of a bag, by their numbers. Raises RecordingError if there is none."""
    if not path.is_dir():
        return (path,)
    found = [each for each in path.iterdir() if Path(each.name.removesuffix(PACKED)).suffix in SUFFIXES]
    if not found:
        remedy = f"Name the folder that holds {' or '.join(SUFFIXES)}."
        raise RecordingError(str(path), "", "is a folder without files of a rosbag 2", remedy=remedy)
    return sorted(found, key=lambda each: [int(number) for number in re.findall(r"\d+", each.stem)])


def _unpacked(path: Path, folder: Path) -> Path:
    from zstandard import ZstdDecompressor

    found = folder / path.stem
    with path.open("rb") as packed, found.open("wb") as file:
        ZstdDecompressor().copy_stream(packed, file)
    return found


def _read_sqlite(log: Log, path: Path) -> None:
    with closing(sqlite3.connect(f"{path.absolute().as_uri()}?mode=ro", uri=True)) as database:
        definitions = _definitions(database)
        topics: dict[int, tuple[str, Decode | str]] = {}
        for key, name, kind, how in database.execute("SELECT id, name, type, serialization_format FROM topics"):
            topics[key] = (name, _decoder(kind, how, definitions))
        for key, log_ns, data in _messages(database, log):
            name, decode = topics.get(key, ("?", "its topic is not known"))
            log.add(name, log_ns, data, decode)
    if not log.truncated and _is_cut(path):
        log.truncated = "the file is shorter than it states: it is read up to there"


def _is_cut(path: Path) -> bool:
    """Whether pages are lacking that the header of SQLite states (https://sqlite.org/fileformat.html, 1.3)."""
    with path.open("rb") as file:
        size, count = struct.unpack(">16xH10xI", file.read(32))
    return int(path.stat().st_size) < int(size if size > 1 else 65536) * int(count)


def _messages(database: sqlite3.Connection, log: Log) -> Iterator[tuple[int, int, Any]]:
    try:
        yield from database.execute("SELECT topic_id, timestamp, data FROM messages")
    except sqlite3.DatabaseError as error:
        if not log.topics:
            raise
        log.truncated = f"the file is cut off or damaged ({error}): it is read up to there"


def _definitions(database: sqlite3.Connection) -> dict[str, tuple[str, str]]:
    """Text and encoding of the definitions by type; bags before ROS 2 Iron have none."""
    try:
        rows = database.execute("SELECT topic_type, encoded_message_definition, encoding FROM message_definitions")
        return {kind: (text, encoding) for kind, text, encoding in rows}
    except sqlite3.DatabaseError:
        return {}


def _decoder(kind: str, how: str, definitions: dict[str, tuple[str, str]]) -> Decode | str:
    """The decoder of a topic's messages, or why there is none."""
    if how != "cdr":
        return f"serialization {how} is not read"
    definition, encoding = definitions.get(kind, ("", ""))
    decode = ros2(definition, kind, encoding)
    return decode if isinstance(decode, str) else lambda data: decode(_plain(data))


def _plain(data: bytes) -> bytes:
    """A message that may be compressed."""
    if not data.startswith(ZSTD):
        return data
    from zstandard import ZstdDecompressor

    return bytes(ZstdDecompressor().decompressobj().decompress(data))
