"""The pendulum's record of tests/support/dialects.py in the formats of other programs, written by their own libraries.

Each function writes to a path; those of several topics have the voltage 3 ms before the angle.
"""

from __future__ import annotations

import json
import struct
import zlib
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any
from warnings import catch_warnings, simplefilter

import numpy as np
from dialects import ANGLE, COUNT, EPOCH, TIME, VOLTAGE

START_NS = EPOCH * 1_000_000_000
LATE_NS = 3_000_000
"""From a voltage to the angle that belongs to it."""
STAMPS = START_NS + 10_000_000 * np.arange(COUNT)
JITTER_NS = np.random.default_rng(3).integers(100_000, 2_000_000, COUNT)
"""From a sample to when its message was logged."""
Write = Callable[[Path], None]


def mcap_json(
    topics: Callable[[int], dict[str, dict[str, Any]]], compression: str = "zstd", count: int = COUNT
) -> Write:
    """The messages of each sample by their topics; the angle's topic is late."""

    def write(path: Path) -> None:
        from mcap.writer import CompressionType, Writer

        with path.open("wb") as file:
            writer = Writer(file, chunk_size=4096, compression=CompressionType[compression.upper()])
            writer.start()
            schema = writer.register_schema("any", "jsonschema", b"{}")
            names = {name: writer.register_channel(name, "json", schema) for name in topics(0)}
            for row in range(count):
                for place, (name, message) in enumerate(topics(row).items()):
                    stamp = int(STAMPS[row]) + place * LATE_NS
                    writer.add_message(names[name], stamp, json.dumps(message).encode(), stamp)
            writer.finish()

    return write


def one_topic(row: int) -> dict[str, dict[str, Any]]:
    return {"/pendulum": {"voltage": VOLTAGE[row], "state": {"angle": ANGLE[row], "mode": "RUN"}}}


def two_topics(row: int) -> dict[str, dict[str, Any]]:
    return {"/motor": {"voltage": VOLTAGE[row]}, "/pivot": {"angle": ANGLE[row], "ok": True}}


def ros_messages(
    store: Any, ros1: bool = False, stamped: bool = True, count: int = COUNT
) -> Iterable[tuple[str, str, int, Any]]:
    """Topic, type, time of the log and message: commands, and joint states of which the second is the pendulum."""
    types = store.types
    more = {"seq": 0} if ros1 else {}
    for row in range(count):
        command = types["std_msgs/msg/Float64"](data=float(VOLTAGE[row]))
        yield "/command", "std_msgs/msg/Float64", int(STAMPS[row]) - LATE_NS, command
        seconds, part = divmod(int(STAMPS[row]) if stamped else row * 10_000_000, 1_000_000_000)
        stamp = types["builtin_interfaces/msg/Time"](sec=seconds, nanosec=part)
        message = types["sensor_msgs/msg/JointState"](
            header=types["std_msgs/msg/Header"](stamp=stamp, frame_id="base", **more),
            name=["wheel", "pivot"],
            position=np.array([0.5, ANGLE[row]]),
            velocity=np.array([0.0, 0.0]),
            effort=np.array([]),
        )
        yield (
            "/joint_states",
            "sensor_msgs/msg/JointState",
            int(STAMPS[row] + (JITTER_NS[row] if stamped else 0)),
            message,
        )


def rosbag1(compression: str = "", stamped: bool = True, count: int = COUNT) -> Write:
    def write(path: Path) -> None:
        from rosbags.rosbag1 import Writer
        from rosbags.typesys import Stores, get_typestore

        store = get_typestore(Stores.ROS1_NOETIC)
        bag = Writer(path)
        if compression:
            bag.set_compression(Writer.CompressionFormat[compression.upper()])
        with bag:
            topics: dict[str, Any] = {}
            for topic, kind, stamp, message in ros_messages(store, True, stamped, count):
                if topic not in topics:
                    topics[topic] = bag.add_connection(topic, kind, typestore=store)
                bag.write(topics[topic], stamp, store.serialize_ros1(message, kind))

    return write


def rosbag2(plugin: str, version: int = 9, stamped: bool = True, packed: str = "", count: int = COUNT) -> Write:
    """A folder, with files of the storage `plugin`, "sqlite3" or "mcap"; `packed`: "file" or "message"."""

    def write(path: Path) -> None:
        from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
        from rosbags.typesys import Stores, get_typestore

        store = get_typestore(Stores.ROS2_HUMBLE)
        bag = Writer(path, version=version, storage_plugin=StoragePlugin[plugin.upper()])
        if packed:
            bag.set_compression(CompressionMode[packed.upper()], CompressionFormat.ZSTD)
        with bag:
            topics: dict[str, Any] = {}
            for topic, kind, stamp, message in ros_messages(store, False, stamped, count):
                if topic not in topics:
                    topics[topic] = bag.add_connection(topic, kind, typestore=store)
                bag.write(topics[topic], stamp, store.serialize_cdr(message, kind))

    return write


def file_of_rosbag2(plugin: str, count: int = COUNT) -> Write:
    """The file of a bag alone, without its metadata.yaml."""

    def write(path: Path) -> None:
        folder = path.with_name("bag")
        rosbag2(plugin, count=count)(folder)
        next(each for each in folder.iterdir() if each.suffix in (".db3", ".mcap")).rename(path)

    return write


def ulog(path: Path, count: int = COUNT) -> None:
    """By the documented layout: two topics, the angle's of two instances."""

    def message(kind: str, content: bytes) -> bytes:
        return struct.pack("<HB", len(content), ord(kind)) + content

    parts = [b"ULog\x01\x12\x35\x01" + struct.pack("<Q", 1000)]
    parts.append(message("B", bytes(40)))
    parts.append(message("F", b"motor:uint64_t timestamp;float voltage;"))
    parts.append(message("F", b"encoder:uint64_t timestamp;double[2] angle;uint8_t ok;"))
    parts.append(message("I", bytes([16]) + b"char[5] sys_name" + b"bench"))
    for place, (name, instance) in enumerate((("motor", 0), ("encoder", 0), ("encoder", 1))):
        parts.append(message("A", struct.pack("<BH", instance, place) + name.encode()))
    for row in range(count):
        stamp = 1_000_000 + 10_000 * row
        parts.append(message("D", struct.pack("<HQf", 0, stamp, VOLTAGE[row])))
        parts.append(message("D", struct.pack("<HQddB", 1, stamp + 3000, ANGLE[row], 0.0, 1)))
        parts.append(message("D", struct.pack("<HQddB", 2, stamp + 4000, -1.0, 0.0, 1)))
    path.write_bytes(b"".join(parts))


def dataflash(path: Path, count: int = COUNT) -> None:
    """By the documented layout: commands, and angles in degrees of two instances, with units."""
    kinds = {
        128: ("FMT", "BBnNZ", "Type,Length,Name,Format,Columns", 89),
        129: ("UNIT", "QbZ", "TimeUS,Id,Label", 76),
        130: ("MULT", "Qbd", "TimeUS,Id,Mult", 20),
        131: ("FMTU", "QBNN", "TimeUS,FmtType,UnitIds,MultIds", 44),
        140: ("MOT", "Qfn", "TimeUS,voltage,Mode", 19),
        141: ("ENC", "QBf", "TimeUS,I,angle", 16),
    }

    def message(kind: int, form: str, *values: Any) -> bytes:
        return bytes((0xA3, 0x95, kind)) + struct.pack(f"<{form}", *values)

    parts = [
        message(128, "BB4s16s64s", kind, size, name.encode(), form.encode(), names.encode())
        for kind, (name, form, names, size) in kinds.items()
    ]
    for unit, label in (("s", "s"), ("v", "V"), ("d", "deg"), ("#", "instance"), ("-", "")):
        parts.append(message(129, "Qb64s", 0, ord(unit), label.encode()))
    for mult, factor in (("-", 0.0), ("F", 1e-6), ("0", 1.0)):
        parts.append(message(130, "Qbd", 0, ord(mult), factor))
    parts.append(message(131, "QB16s16s", 0, 140, b"sv-", b"F0-"))
    parts.append(message(131, "QB16s16s", 0, 141, b"s#d", b"F-0"))
    for row in range(count):
        stamp = 1_000_000 + 10_000 * row
        parts.append(message(140, "Qf4s", stamp, VOLTAGE[row], b"RUN"))
        for instance, angle in enumerate((np.degrees(ANGLE[row]), -1.0)):
            parts.append(message(141, "QBf", stamp + 3000 + instance, instance, angle))
    path.write_bytes(b"".join(parts))


def mf4(
    *groups: dict[str, tuple[np.ndarray, str]], version: str = "4.10", times: tuple[np.ndarray, ...] = (TIME,)
) -> Write:
    """A channel group for each of `groups`: values and unit by name."""

    def write(path: Path) -> None:
        from asammdf import MDF, Signal

        with MDF(version=version) as file:
            for time, group in zip(times, groups, strict=True):
                file.append(
                    [
                        Signal(values, time, name=name, unit=unit, encoding="utf-8")
                        for name, (values, unit) in group.items()
                    ]
                )
            file.save(path, overwrite=True)

    return write


FRAME = (
    ("BusChannel", "u1"),
    ("ID", "<u4"),
    ("IDE", "u1"),
    ("DLC", "u1"),
    ("DataLength", "u1"),
    ("DataBytes", "(8,)u1"),
)
"""The fields of a frame in MF4 bus logging, and their types."""


def bus_log(kinds: dict[str, np.ndarray], times: np.ndarray, compression: int = 0) -> Write:
    """MF4 bus logging, a channel group for each of `kinds` of frames (`CAN_DataFrame`), as python-can lays it out."""

    def write(path: Path) -> None:
        from asammdf import MDF, Signal

        with MDF(version="4.10") as file:
            for name, frames in kinds.items():
                named = frames.view([(f"{name}.{field}", *kind) for field, *kind in frames.dtype.descr])
                file.append(Signal(named, times[: len(frames)], name=name))
            file.save(path, overwrite=True, compression=compression)

    return write


def mat5(content: dict[str, Any], **options: Any) -> Write:
    def write(path: Path) -> None:
        from scipy.io import savemat

        savemat(path, content, **options)

    return write


def unpacked(write: Write) -> Write:
    """The MAT file of version 5 that `write` makes, with its variables as they are inside of the compressed ones."""

    def write_unpacked(path: Path) -> None:
        write(path)
        content = path.read_bytes()
        found, place, workspace = bytearray(content[:128]), 128, struct.unpack_from("<Q", content, 116)[0]
        while place < len(content):
            if place == workspace:
                struct.pack_into("<Q", found, 116, len(found))
            kind, size = struct.unpack_from("<II", content, place)
            data = content[place : place + 8 + size]
            found += zlib.decompress(data[8:]) if kind == 15 else data
            place += len(data)
        path.write_bytes(found)

    return write_unpacked


def mat73(columns: dict[str, np.ndarray], struct: str = "", kind: str = "double") -> Write:
    """Version 7.3 as MATLAB lays it out: HDF5 behind a header of 512 bytes, arrays of the class `kind` transposed."""

    def write(path: Path) -> None:
        import h5py

        with h5py.File(path, "w", userblock_size=512) as file:
            where = file.create_group(struct) if struct else file
            if struct:
                where.attrs["MATLAB_class"] = np.bytes_("struct")
            for name, values in columns.items():
                data = where.create_dataset(name, data=np.atleast_2d(values))
                data.attrs["MATLAB_class"] = np.bytes_(kind)
        head = b"MATLAB 7.3 MAT-file, Platform: GLNXA64, Created on: Fri Mar  1 12:00:00 2024 HDF5 schema 1.00 ."
        with path.open("r+b") as raw:
            raw.write(head.ljust(124) + b"\x00\x02IM")

    return write


def timeseries(name: str, values: np.ndarray, even: bool = False, unit: str = "") -> Any:
    from matio.utils.matclass import MatlabOpaque

    info: dict[str, Any] = {"Units": "seconds"}
    if even:
        info |= {"Start": np.array([[0.0]]), "Increment": np.array([[0.01]]), "Length": np.array([[float(COUNT)]])}
    fields = {
        "Name": name,
        "Time_": np.empty((0, 0)) if even else TIME[:, None],
        "Data_": values[:, None],
        "TimeInfo_": MatlabOpaque(info, "tsdata.timemetadata"),
        "DataInfo_": MatlabOpaque({"Units": unit}, "tsdata.datametadata"),
    }
    return MatlabOpaque(fields, "timeseries")


def objects(content: Callable[[], dict[str, Any]], version: str) -> Write:
    """Objects of MATLAB, in version "v7" or "v7.3"."""

    def write(path: Path) -> None:
        with catch_warnings():
            simplefilter("ignore")  # mat-io sets an option that pandas 3 does not need any more
            from matio import save_to_mat

            save_to_mat(str(path), content(), version=version)

    return write


def two_series() -> dict[str, Any]:
    return {"u": timeseries("voltage", VOLTAGE, unit="V"), "y": timeseries("angle", ANGLE, even=True, unit="rad")}


def degrees_series() -> dict[str, Any]:
    return {"u": timeseries("voltage", VOLTAGE), "y": timeseries("angle", np.degrees(ANGLE), unit="deg")}


def minutes_beside_seconds() -> dict[str, Any]:
    """A timeseries in minutes, beside vectors over a time in seconds."""
    series = timeseries("angle", ANGLE)
    series.properties["Time_"] = series.properties["Time_"] / 60.0
    series.properties["TimeInfo_"].properties["Units"] = "minutes"
    return {"time": TIME[:, None], "voltage": VOLTAGE[:, None], "y": series}


def timetable() -> dict[str, Any]:
    """A timetable by mat-io, which takes it from a DataFrame."""
    import pandas as pd

    index = pd.to_timedelta(np.round(TIME * 1e9).astype(np.int64), unit="ns")
    return {"run": pd.DataFrame({"voltage": VOLTAGE, "angle": ANGLE}, index=pd.Index(index, name="Time"))}


def dataset() -> dict[str, Any]:
    """A Dataset of signals, as Simulink logs them."""
    from matio.utils.matclass import MatlabOpaque

    cell = np.empty((2, 1), dtype=object)
    for place, (name, values) in enumerate((("voltage", VOLTAGE), ("angle", ANGLE))):
        fields = {"Name": name, "Values": timeseries("", values)}
        cell[place, 0] = MatlabOpaque(fields, "Simulink.SimulationData.Signal")
    return {"logsout": MatlabOpaque({"Name": "logsout", "Storage_": cell}, "Simulink.SimulationData.Dataset")}


def structure_with_time() -> dict[str, Any]:
    """What Simulink's scopes and To Workspace blocks log."""
    signals = np.empty((1, 2), dtype=[("values", object), ("label", object)])
    signals[0, 0] = (VOLTAGE[:, None], "voltage")
    signals[0, 1] = (ANGLE[:, None], "angle")
    return {"ScopeData": {"time": TIME[:, None], "signals": signals, "blockName": "model/Scope"}}


def plotjuggler() -> bytes:
    """Its CSV: a row for each instant of any topic."""
    rows = [
        line
        for row in range(COUNT)
        for line in (
            f"{EPOCH + TIME[row]:.6f},{VOLTAGE[row]:.4f},",
            f"{EPOCH + TIME[row] + 0.003:.6f},,{ANGLE[row]:.6f}",
        )
    ]
    return "\n".join(["__time,/command/data,/joint_states/pivot/position", *rows, ""]).encode()
