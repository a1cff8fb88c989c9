"""Recordings in the formats of other programs: their bytes changed, and correct files of odd content."""

from __future__ import annotations

import json
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import Any
from warnings import catch_warnings, simplefilter

import log_files
import numpy as np
from dialects import ANGLE, TIME, VOLTAGE, columns, feather
from hypothesis import strategies as st
from log_files import Write

from fuzz.mutation import mutated
from fuzz.target import Target, of_file
from upright.telemetry import storage
from upright.telemetry.errors import RecordingError
from upright.telemetry.tables.mapping import NOTHING, said_of
from upright.telemetry.tables.wanted import Wanted

WANTED = (Wanted("voltage", "V", held=True), Wanted("angle", "rad", measured=True), Wanted("rate", "rad/s"))
USERS = (NOTHING, said_of(("angle=column3:deg",), ("time=ms",)), said_of((), ("angle=wrapped", "voltage=-1")))


def read_of_others(path: Path) -> None:
    """Read a file as it is, and as some users say."""
    refusals: list[RecordingError] = []
    for user in USERS:
        try:
            found = storage.load_all(path, WANTED, user)
        except RecordingError as error:
            refusals.append(error)
            continue
        for each in found:
            assert np.all(np.diff(each.timestamp_ns) > 0)
            assert all(len(column) == len(each) for column in each.values.values())
    assert all(each.remedy for each in refusals)
    if len(refusals) == len(USERS):
        raise refusals[0]


# Seeds

FEW = 40
"""Samples, so that changes meet the heads of the files."""
HEAD = 1024
"""Bytes at the beginning of a file in which half of the changes are made."""
SIGNALS = {"time": TIME[:FEW], "voltage": VOLTAGE[:FEW], "angle": ANGLE[:FEW]}
CHANNELS = {"voltage": (VOLTAGE[:FEW], "V"), "angle": (np.degrees(ANGLE[:FEW]), "deg")}


def content(write: Write, suffix: str) -> bytes:
    """What `write` puts into a file of that suffix; asammdf gives those of MDF 3 another one."""
    with tempfile.TemporaryDirectory() as folder:
        write(Path(folder) / f"seed{suffix}")
        return next(each for each in Path(folder).iterdir() if each.is_file()).read_bytes()


def safe(write: Write, suffix: str) -> bytes:
    """As `content`; nothing, if the package that writes it refuses what it is given."""
    try:
        with catch_warnings():
            simplefilter("ignore")
            return content(write, suffix)
    except Exception:  # the packages have no common one
        return b""


# Odd content

NUMBERS = (0.0, -1.0, 1e-3, 1e308, 5e-324, 2.0**53, -(2.0**63), float("nan"), float("inf"), -float("inf"))
NAMES = ("time", "t", "Time [ms]", "angle", "voltage", "data", "name", "signals", "values", "unit", "metadata", "½", "")
KEYS = (*NAMES, "header", "stamp", "sec", "nanosec")
WORDS = ("", "angle", "s", "minutes", "½", "\0", "x" * 300, "[" * 3000, '{"a": 1}', "nan")
STAMPS = st.one_of(st.sampled_from((0, 1, 10**18, 2**62, 2**63 - 1, 2**63, 2**64 - 1)), st.integers(0, 10**9))


def vectors() -> st.SearchStrategy[Any]:
    """Arrays of any type and shape."""
    shapes = st.sampled_from(((4,), (4, 1), (1, 4), (4, 4), (0, 0), (1, 1), (2, 3, 4), (4, 65), (4, 0)))
    kinds = st.sampled_from(("f8", "f4", "i8", "u8", "i2", "u1", "?", "c16"))
    return st.builds(array, shapes, kinds, st.lists(st.sampled_from(NUMBERS), min_size=1, max_size=4))


def array(shape: tuple[int, ...], kind: str, values: Sequence[float]) -> Any:
    with np.errstate(all="ignore"):
        return np.resize(np.array(values), shape).astype(kind)


def times() -> st.SearchStrategy[Any]:
    """Four instants: rising, repeated, backwards, unknown."""
    rows = ([0.0, 0.1, 0.2, 0.3], [0.0] * 4, [3.0, 2.0, 1.0, 0.0], [0.0, np.nan, 0.2, 0.3], [0.0, np.inf, 1e300, 2.0])
    return st.sampled_from(rows).map(np.array)


def values() -> st.SearchStrategy[Any]:
    """What a variable of MATLAB may be: arrays, texts, structs and cells of them."""
    leaves = st.one_of(vectors(), times(), st.sampled_from(NUMBERS), st.sampled_from(WORDS))
    return st.recursive(
        leaves,
        lambda inner: st.one_of(
            st.dictionaries(st.sampled_from(NAMES[:-2]), inner, max_size=4), st.lists(inner, max_size=3).map(cell)
        ),
        max_leaves=6,
    )


def cell(elements: Sequence[Any]) -> Any:
    found = np.empty((1, len(elements)), dtype=object)
    for place, each in enumerate(elements):
        found[0, place] = each
    return found


def variables() -> st.SearchStrategy[bytes]:
    """Files of version 5 with odd variables."""
    named = st.dictionaries(st.sampled_from(NAMES), values(), min_size=1, max_size=4)
    return st.builds(
        lambda found, packed: safe(log_files.mat5(found, do_compression=packed), ".mat"), named, st.booleans()
    )


def datasets() -> st.SearchStrategy[bytes]:
    """Files of version 7.3 with odd data sets, in a struct or alone."""
    named = st.dictionaries(st.sampled_from(NAMES), st.one_of(vectors(), times()), min_size=1, max_size=4)
    kinds = st.sampled_from(("double", "int64", "char", "logical", "cell", "struct", "timeseries", "½", ""))
    inside = st.sampled_from(("", "run"))
    return st.builds(
        lambda found, kind, struct: safe(log_files.mat73(found, struct, kind), ".mat"), named, kinds, inside
    )


def groups() -> st.SearchStrategy[bytes]:
    """MF4 files with odd channels, times, units and comments."""
    samples = st.one_of(
        vectors(), times(), st.just(np.array([b"RUN"] * 4)), st.just(np.zeros(4, dtype=[("a", "f8"), ("b", "i2")]))
    )
    channel = st.tuples(samples, st.sampled_from(("", "V", "deg", "½", "ms", *WORDS)))
    group = st.dictionaries(st.sampled_from((*NAMES, "x" * 300)), channel, min_size=1, max_size=3)
    return st.builds(
        lambda several, clocks, version: safe(
            log_files.mf4(*several, version=version, times=tuple(clocks[: len(several)])), ".mf4"
        ),
        st.lists(group, min_size=1, max_size=2),
        st.lists(times(), min_size=2, max_size=2),
        st.sampled_from(("4.10", "4.20", "3.30")),
    )


def messages() -> st.SearchStrategy[bytes]:
    """MCAP files with odd messages of one or two topics."""
    leaves = st.one_of(st.sampled_from((*NUMBERS, *WORDS, None, True, 10**400, 2**63)), st.integers(-(2**70), 2**70))
    message = st.recursive(
        leaves,
        lambda inner: st.one_of(st.lists(inner, max_size=3), st.dictionaries(st.sampled_from(KEYS), inner, max_size=4)),
        max_leaves=8,
    ).map(lambda found: json.dumps(found).encode())
    parts = st.tuples(st.sampled_from(("/a", "angle", "", "½")), STAMPS, st.one_of(message, st.binary(max_size=40)))
    return st.builds(
        lambda rows, encoding, schema: safe(partial(mcap, rows=rows, encoding=encoding, schema=schema), ".mcap"),
        st.lists(parts, min_size=1, max_size=6),
        st.sampled_from(("json", "json", "json", "cdr", "ros1", "protobuf", "")),
        st.one_of(
            st.sampled_from(SCHEMAS), st.tuples(st.sampled_from(WORDS), st.sampled_from(WORDS), st.binary(max_size=40))
        ),
    )


SCHEMAS = (
    ("any", "jsonschema", b'{"properties": {"angle": {"description": "lean (deg)"}}}'),
    ("any", "jsonschema", b'{"properties": {"angle": {"description": null}}}'),
    ("any", "jsonschema", b'{"properties": [1]}'),
    ("any", "jsonschema", b"[" * 100_000),
    ("std_msgs/msg/Float64", "ros2msg", b"float64 data"),
    ("a/msg/B", "ros2msg", b"float64[] angle\nstring[] name"),
    ("a/msg/B", "ros2msg", b"float64[<=4] angle\na/msg/B b"),
    ("a/msg/B", "ros2idl", b"module a { module msg { struct B { double angle; }; }; };"),
)
"""Names, encodings and definitions."""


def mcap(path: Path, rows: Sequence[tuple[str, int, bytes]], encoding: str, schema: tuple[str, str, bytes]) -> None:
    """Write messages: topic, time of the log and data."""
    from mcap.writer import CompressionType, Writer

    with path.open("wb") as file:
        writer = Writer(file, compression=CompressionType.NONE)
        writer.start()
        number = writer.register_schema(*schema)
        topics = {name: writer.register_channel(name, encoding, number) for name, _, _ in rows}
        for name, stamp, data in rows:
            writer.add_message(topics[name], stamp, data, stamp)
        writer.finish()


def tables() -> st.SearchStrategy[bytes]:
    """Feather files of both versions with odd columns."""
    return st.builds(
        lambda time, angle, version: safe(partial(feather_of, time=time, angle=angle, version=version), ".feather"),
        times(),
        vectors().filter(lambda found: found.shape == (4,)),
        st.sampled_from((1, 2)),
    )


def feather_of(path: Path, time: Any, angle: Any, version: int) -> None:
    import pyarrow as pa
    import pyarrow.feather

    pa.feather.write_feather(
        pa.table({"time": time, "angle": angle}), path, compression="uncompressed", version=version
    )


# The formats


@dataclass(frozen=True)
class Format:
    """A format: how its `seeds` are written, and a strategy of correct files of `odd` content, if there is one."""

    name: str
    suffix: str
    seeds: tuple[Write, ...]
    odd: Callable[[], st.SearchStrategy[bytes]] | None = None


FORMATS = (
    Format("db3", ".db3", (log_files.file_of_rosbag2("sqlite3", count=FEW),)),
    Format("bag", ".bag", (log_files.rosbag1(count=FEW),)),
    Format("ulg", ".ulg", (partial(log_files.ulog, count=FEW),)),
    Format("bin", ".bin", (partial(log_files.dataflash, count=FEW),)),
    Format(
        "mcap",
        ".mcap",
        (
            log_files.mcap_json(log_files.one_topic, "none", FEW),
            log_files.mcap_json(log_files.two_topics, "zstd", FEW),
            log_files.file_of_rosbag2("mcap", count=FEW),
        ),
        messages,
    ),
    Format(
        "mat5",
        ".mat",
        (
            log_files.mat5(SIGNALS),
            log_files.mat5({"run": SIGNALS}, do_compression=True),
            log_files.mat5(SIGNALS, format="4"),
            log_files.mat5(log_files.structure_with_time()),
            log_files.objects(log_files.two_series, "v7"),
            log_files.unpacked(log_files.objects(log_files.two_series, "v7")),
        ),
        variables,
    ),
    Format(
        "mat73",
        ".mat",
        (
            log_files.mat73(SIGNALS),
            log_files.mat73(SIGNALS, "run"),
            log_files.objects(log_files.two_series, "v7.3"),
            log_files.objects(log_files.dataset, "v7.3"),
        ),
        datasets,
    ),
    Format(
        "mf4",
        ".mf4",
        (
            log_files.mf4(CHANNELS, times=(TIME[:FEW],)),
            log_files.mf4({"voltage": CHANNELS["voltage"]}, {"angle": CHANNELS["angle"]}, times=(TIME[:FEW],) * 2),
            log_files.mf4(CHANNELS, version="3.30", times=(TIME[:FEW],)),
        ),
        groups,
    ),
    Format("feather", ".feather", (lambda path: path.write_bytes(feather(columns(TIME))) and None,), tables),
)


@cache
def written(form: Format) -> tuple[bytes, ...]:
    """The seeds of a format as files."""
    return tuple(content(write, form.suffix) for write in form.seeds)


def inputs(form: Format) -> st.SearchStrategy[bytes]:
    """Changed bytes of the seeds, at their heads too, and files of odd content."""
    changed = st.one_of(mutated(written(form)), mutated(written(form), head=HEAD))
    return changed if form.odd is None else st.one_of(changed, form.odd())


def examples(form: Format) -> Sequence[bytes]:
    return written(form)


TARGETS = tuple(
    Target(
        form.name,
        f"a recording of another program, {form.name}",
        of_file(form.suffix, read_of_others),
        partial(inputs, form),
        partial(examples, form),
        seconds=5.0,
        megabytes=300,
    )
    for form in FORMATS
)
