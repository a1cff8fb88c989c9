"""Messages of ROS 1 and 2 by the definitions that their log holds (rosbags, the extra `upright[ros]`)."""

from __future__ import annotations

from typing import Any

from telemetry.formats.topics import Decode


def ros2(definition: str, name: str, encoding: str = "ros2msg") -> Decode:
    """The decoder of CDR messages of type `name`, whose `definition` is a `.msg` ("ros2msg") or an IDL ("ros2idl").
    Without a definition the type has to be one of ROS itself. Raises TypesysError of rosbags."""
    store, name = _store(definition, name, encoding)
    return lambda data: store.deserialize_cdr(data, name)


def ros1(definition: str, name: str) -> Decode:
    """The decoder of ROS 1 messages of type `name`. Raises TypesysError of rosbags."""
    store, name = _store(definition, name, "ros1msg")
    return lambda data: store.deserialize_ros1(data, name)


def _store(definition: str, name: str, encoding: str) -> tuple[Any, str]:
    """Types of their own for each definition, since those of one name may differ from log to log."""
    from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore
    from rosbags.typesys.msg import normalize_msgtype

    if not definition:
        return get_typestore(Stores.LATEST), name
    store = get_typestore(Stores.EMPTY)
    name = normalize_msgtype(name)
    store.register(get_types_from_idl(definition) if encoding == "ros2idl" else get_types_from_msg(definition, name))
    return store, name
