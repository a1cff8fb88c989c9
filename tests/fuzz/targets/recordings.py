"""Recordings, in every format that is read, and what is first asked of each."""

from __future__ import annotations

import io
import json
import tempfile
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet
from dialects import (
    BASE,
    arduino,
    in_turns,
    influx,
    labview,
    oscilloscope,
    own_clocks,
    picoscope,
    rigol,
    ros_stamps,
    text,
    tidy,
)
from golden import FOLDER
from hypothesis import strategies as st

from fuzz.mutation import anything, mutated
from fuzz.target import Target, of_file
from fuzz.targets.formats import read_of_others
from upright.estimators.contract import EstimationError
from upright.estimators.data.segments import segments
from upright.estimators.identify.table import experiment_of
from upright.service.dashboard.recordings import Folder
from upright.service.offline.inputs import replay
from upright.telemetry import storage
from upright.telemetry.recording import Recording
from upright.vehicles import registry
from upright.vehicles.experiment.load import load_of
from upright.vehicles.file import load
from upright.vehicles.sections import VehicleFile

SUFFIXES = storage.SUFFIXES
EXTREMES = (float("nan"), float("inf"), -float("inf"), 0.0, -0.0, 1e308, -1e308, 5e-324, 1.0, -3.0)
INSTANTS = (-(2**63), -1, 0, 1, 4_000_000, 8_000_000, 10**18, 2**62, 2**63 - 2, 2**63 - 1)
TEXTS = (
    "",
    "{}",
    "[]",
    "null",
    "nan",
    "NaN",
    "[" * 3000,
    '{"load": 1}',
    '{"load": {"torque": NaN}}',
    "1e999",
    "-1",
    "0",
    '{"inertia": null}',
    '{"inertia": -1}',
    '{"inertia": NaN}',
    "x" * 5000,
    "\0",
    '{"excitation": []}',
    "½",
)
KEYS = (
    "parameters",
    "experiment_definition",
    "support",
    "vehicle",
    "kind",
    "start_ns",
    "end_reason",
    "experiment",
    "own",
)


@cache
def vehicle() -> VehicleFile:
    return load("monocab")


@cache
def short() -> Recording:
    """A quarter of a second of a run of the MONOCAB."""
    source = sorted(FOLDER.glob("monocab*.parquet"))[0]
    whole = storage.load(source)
    return whole.between(whole.duration / 2.0, whole.duration / 2.0 + 0.25)


@cache
def written(suffix: str) -> bytes:
    """`short` as a file."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"seed{suffix}"
        storage.save(short(), path)
        return path.read_bytes()


def ask(path: Path) -> None:
    """Load it, and ask what every user of a recording asks first."""
    recording = replay.with_age(storage.load(path), vehicle())
    assert np.all(np.diff(recording.time) >= 0.0)
    assert recording.duration >= 0.0
    assert recording.rate >= 0.0
    experiment_of(recording)
    load_of(recording)
    Folder(path.parent).open(path.name, 100)
    beside = path.with_name(f"beside{path.suffix}")
    storage.save(recording, beside)
    assert len(storage.load(beside)) == len(recording)
    registry.recorded_loop(vehicle(), recording)
    for _ in recording.frames():
        pass
    with suppress(EstimationError):  # it cannot be identified from, and says so
        segments(registry.models_of(vehicle()).nominal, [recording])


def columns() -> st.SearchStrategy[pa.Table]:
    """Tables with any columns, values, instants and texts."""
    names = st.lists(
        st.sampled_from([*short().channels.names, "time", "timestamp_ns", "own", "", "a b", "½"]), max_size=12
    )
    return st.builds(
        table,
        names,
        st.lists(st.one_of(st.sampled_from(INSTANTS), st.integers(-(2**63), 2**63 - 1)), max_size=8).map(sorted),
        st.lists(st.sampled_from(EXTREMES), min_size=1, max_size=20),
        st.sampled_from(
            (
                pa.float64(),
                pa.float32(),
                pa.int64(),
                pa.float64(),
                pa.uint64(),
                pa.string(),
                pa.bool_(),
                pa.null(),
                pa.timestamp("ns"),
                pa.float16(),
            )
        ),
        st.dictionaries(st.sampled_from(KEYS), st.sampled_from(TEXTS), max_size=6),
        st.integers(0, 11),
    )


def table(
    names: Sequence[str], stamps: Sequence[int], values: Sequence[float], odd: Any, texts: dict[str, str], place: int
) -> Any:
    """A table of `names`, its column at `place` of the type `odd`."""
    arrays, fields = [], []
    for column, name in enumerate([*names, "timestamp_ns"] if place % 4 else names):
        if name == "timestamp_ns":
            found = pa.array(stamps, pa.int64())
        else:
            found = pa.array([values[(column + row) % len(values)] for row in range(len(stamps))], pa.float64())
        if column == place and odd != pa.float64():
            filled = (
                [None] * len(stamps) if odd in (pa.string(), pa.null()) else [row % 2 for row in range(len(stamps))]
            )
            found = (
                pa.array(filled, pa.int64()).cast(odd)
                if filled and filled[0] is not None
                else pa.nulls(len(stamps), odd)
            )
        arrays.append(found)
        fields.append(pa.field(name, found.type))
    return pa.Table.from_arrays(arrays, schema=pa.schema(fields, metadata=texts))


def texts() -> st.SearchStrategy[Any]:
    """The recording with other texts."""
    whole = {key: value for key, value in short().metadata.items() if len(value) < 10_000}
    changed = st.dictionaries(
        st.sampled_from(sorted({*KEYS, *whole})),
        st.one_of(st.sampled_from(TEXTS), mutated_json()),
        min_size=1,
        max_size=3,
    )
    return changed.map(
        lambda new: pa.parquet.read_table(io.BytesIO(written(".parquet"))).replace_schema_metadata({**whole, **new})
    )


def mutated_json() -> st.SearchStrategy[str]:
    known = [value.encode() for key, value in short().metadata.items() if key in KEYS] or [b"{}"]
    return mutated([*known, json.dumps({"inertia": 1600.0}).encode()], [b"NaN", b"null", b"[", b"1e999"]).map(
        lambda data: data.decode(errors="replace")
    )


BROKEN = (
    (["time", "roll", "roll"], [[0.0, 0.1]] * 3, {}),
    (["timestamp_ns"], [[1, 2]], {}),
    (["timestamp_ns", "roll"], [[-(2**63), 2**63 - 1], [0.0, 0.1]], {}),
    (["time", "roll"], [[0.0, float("nan")], [0.0, 0.1]], {}),
    (["time", "roll"], [[0.0, 1e300], [0.0, 0.1]], {}),
    (["time", "roll", "roll_rate", "phase"], [[0.0, 0.1]] * 4, {"support": "{"}),
)
"""Correct tables that are no recordings."""


def broken(as_file: Callable[[Any], bytes]) -> list[bytes]:
    return [
        as_file(pa.Table.from_arrays(list(map(pa.array, columns)), names).replace_schema_metadata(texts))
        for names, columns, texts in BROKEN
    ]


def stream(table: Any) -> bytes:
    sink = io.BytesIO()
    with pa.ipc.new_stream(sink, table.schema) as writer:
        writer.write_table(table)
    return sink.getvalue()


def parquet(table: Any) -> bytes:
    sink = io.BytesIO()
    pa.parquet.write_table(table, sink)
    return sink.getvalue()


def either(as_file: Callable[[Any], bytes], suffix: str) -> Callable[[], st.SearchStrategy[bytes]]:
    """Changed bytes of a file, at its head above all, or a correct file of odd content."""

    def safe(table: Any) -> bytes:
        try:
            return as_file(table)
        except pa.ArrowException:
            return b""  # it cannot be written

    return lambda: st.one_of(anything([written(suffix)], head=3000), columns().map(safe), texts().map(safe))


# CSV

FIELDS = (
    b"nan",
    b"inf",
    b"1e999",
    b"",
    b" ",
    b"x",
    b'"',
    b'"a\nb"',
    b"1,5",
    b"1_0",
    b"0x10",
    b"9" * 400,
    b"\x00",
    b"\xff",
    b"-0",
    b"time",
)


@st.composite
def lines(draw: st.DrawFn) -> bytes:
    """A table of text with odd fields."""
    rows = [line.split(b",") for line in written(".csv").split(b"\r\n")[: draw(st.integers(1, 8))]]
    for _ in range(draw(st.integers(1, 4))):
        row = draw(st.sampled_from(rows))
        row[draw(st.integers(0, len(row) - 1))] = draw(st.sampled_from(FIELDS))
    return draw(st.sampled_from((b"\r\n", b"\n", b"\r"))).join(b",".join(row) for row in rows)


# Tables of others, by the dialects that are read

PIECES = (
    *FIELDS,
    b";",
    b"\t",
    b"sep=;\n",
    b"# ",
    b"time",
    b"[deg]",
    b"(ms)",
    b"2024-03-01T12:00:00.010Z",
    b"99.99.9999 99:99",
    b"12:00:00",
    b"-9999",
    b"1.234,5",
    b"t:",
    b"\xff\xfe",
    b"\r\n",
    b"True",
)


@cache
def dialects() -> tuple[bytes, ...]:
    """A few lines of each kind of table."""
    base = text(BASE[:12])
    made = (influx(), labview(), arduino(), rigol(), picoscope(), oscilloscope(), tidy(), own_clocks(), ros_stamps())
    return (base, base.replace(b",", b";").replace(b".", b","), *(each[:700] for each in (*made, in_turns(0.003))))


TARGETS = (
    Target(
        "arrow",
        "a recording, .arrow",
        of_file(".arrow", ask),
        either(stream, ".arrow"),
        lambda: [written(".arrow"), *broken(stream)],
        megabytes=300,
    ),
    Target(
        "parquet",
        "a recording, .parquet",
        of_file(".parquet", ask),
        either(parquet, ".parquet"),
        lambda: [written(".parquet"), *broken(parquet)],
        megabytes=300,
    ),
    Target(
        "csv",
        "a recording, .csv",
        of_file(".csv", ask),
        lambda: st.one_of(lines(), anything([written(".csv")[:4000]], FIELDS)),
        lambda: [written(".csv")],
    ),
    Target(
        "table",
        "a table of another program",
        of_file(".csv", read_of_others),
        lambda: anything(list(dialects()), PIECES),
        lambda: list(dialects()),
    ),
)
