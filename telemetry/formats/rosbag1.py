"""Bags of ROS 1 (rosbags, the extra `upright[ros]`)."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from upright.telemetry.formats.ros_messages import ros1
from upright.telemetry.formats.topics import Decode, Log
from upright.telemetry.tables.raw import RawTable


def read(path: Path) -> Sequence[RawTable]:
    """A table for each topic. Raises RecordingError, OSError, and what rosbags raises."""
    from rosbags.rosbag1 import Reader

    log = Log(str(path))
    decoders: dict[int, Decode | str] = {}
    with Reader(path) as bag:
        for connection, log_ns, data in bag.messages():
            if connection.id not in decoders:
                decoders[connection.id] = ros1(connection.msgdef.data, connection.msgtype)
            log.add(connection.topic, log_ns, data, decoders[connection.id])
    return log.tables()
