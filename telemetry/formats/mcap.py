"""MCAP (Foxglove, ROS 2) with messages in JSON or of ROS 1 and 2; https://mcap.dev/spec.

The records are read in their order and not by the index at the end, so that a file that was cut off is read as well.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from upright.telemetry.formats.topics import Decode, Log
from upright.telemetry.tables.raw import RawTable
from upright.telemetry.tables.units import name_and_unit

OWN = "upright"
"""The metadata record that upright writes."""


def read(path: Path) -> Sequence[RawTable]:
    """A table for each topic. Raises RecordingError, OSError, and what its packages raise."""
    log = Log(str(path))
    read_into(log, path)
    return log.tables()


def read_into(log: Log, path: Path) -> None:
    """Add the messages of a file to `log`."""
    from mcap.records import Channel, Message, Metadata, Schema
    from mcap.stream_reader import StreamReader

    schemas: dict[int, Any] = {}
    channels: dict[int, Any] = {}
    decoders: dict[int, Decode | str] = {}
    with path.open("rb") as file:
        records = iter(StreamReader(file, record_size_limit=path.stat().st_size).records)
        while (record := _next(records, log)) is not None:
            if isinstance(record, Schema):
                schemas[record.id] = record
            elif isinstance(record, Channel):
                channels[record.id] = record
            elif isinstance(record, Metadata) and record.name == OWN:
                log.metadata.update(record.metadata)
            elif isinstance(record, Message):
                channel = channels[record.channel_id]
                if record.channel_id not in decoders:
                    decoders[record.channel_id] = _decoder(channel, schemas.get(channel.schema_id))
                    log.topic(channel.topic).units = _units(schemas.get(channel.schema_id))
                log.add(channel.topic, record.log_time, record.data, decoders[record.channel_id])


def _next(records: Any, log: Log) -> Any:
    """The next record, None at the end or where the file was cut off. Raises what mcap raises at the beginning."""
    try:
        return next(records, None)
    except ImportError:
        raise
    except Exception as error:  # mcap, zstandard and lz4 have no common one
        if not log.topics:
            raise
        log.truncated = f"the file is cut off or damaged ({type(error).__name__}): it is read up to there"
        return None


def _decoder(channel: Any, schema: Any) -> Decode | str:
    """The decoder of a channel's messages, or why there is none."""
    if channel.message_encoding == "json":
        return json.loads
    if channel.message_encoding in ("cdr", "ros1") and schema is not None:
        from upright.telemetry.formats.ros_messages import ros1, ros2

        definition = schema.data.decode(errors="replace")
        if channel.message_encoding == "ros1":
            return ros1(definition, schema.name)
        return ros2(definition, schema.name, schema.encoding)
    return f"encoding {channel.message_encoding or 'unknown'} is not read"


def _units(schema: Any) -> Mapping[str, str]:
    """The units that the descriptions of a JSON schema end with, `(rad)`."""
    if schema is None or schema.encoding != "jsonschema":
        return {}
    try:
        properties = json.loads(schema.data)["properties"]
        return {name: name_and_unit(each.get("description", ""))[1] for name, each in properties.items()}
    except (ValueError, KeyError, TypeError, AttributeError):
        return {}
