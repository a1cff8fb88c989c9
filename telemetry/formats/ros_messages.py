"""Messages of ROS 1 and 2 by the definitions that their log holds (rosbags, the extra `upright[ros]`)."""

from __future__ import annotations

from typing import Any

from upright.telemetry.formats.topics import Decode


def ros2(definition: str, name: str, encoding: str = "ros2msg") -> Decode | str:
    """The decoder of CDR messages of type `name`, whose `definition` is a `.msg` ("ros2msg") or an IDL ("ros2idl"), or
    why there is none. Without a definition the type has to be one of ROS itself."""
    return _decoder(definition, name, encoding, "deserialize_cdr")


def ros1(definition: str, name: str) -> Decode | str:
    """The decoder of ROS 1 messages of type `name`, or why there is none."""
    return _decoder(definition, name, "ros1msg", "deserialize_ros1")


def _decoder(definition: str, name: str, encoding: str, how: str) -> Decode | str:
    """Types are registered for each definition alone, since those of one name may differ from log to log."""
    from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore
    from rosbags.typesys.msg import normalize_msgtype

    name = normalize_msgtype(name)
    store: Any = get_typestore(Stores.EMPTY if definition else Stores.LATEST)
    try:
        if definition:
            parse = get_types_from_idl if encoding == "ros2idl" else lambda text: get_types_from_msg(text, name)
            store.register(parse(definition))
        store.get_msgdef(name)
    except Exception as error:  # rosbags' parsers have several
        return f"its type {name} is not known ({type(error).__name__})"
    decode = getattr(store, how)
    return lambda data: decode(data, name)
