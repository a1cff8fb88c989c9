"""CAN logs in every format that is read, and the DBC that says what their signals are."""

from __future__ import annotations

import gzip
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import cache
from pathlib import Path

import can
import log_files
import numpy as np
from hypothesis import strategies as st

from fuzz.mutation import anything, exchanged, mutated
from fuzz.target import Target, Trial, of_file
from fuzz.targets.formats import HEAD, content, safe, times
from fuzz.targets.recordings import FIELDS, vehicle
from upright.service.offline.inputs import replay
from upright.service.offline.inputs.can_log import open_log
from upright.service.offline.inputs.dbc import signals, table_of
from upright.service.virtual.run import ClosedLoop
from upright.telemetry.candump import CandumpReader, format_frame
from upright.telemetry.samples import CanFrame


@cache
def frames() -> tuple[CanFrame, ...]:
    """Some cycles of IMU and drives at rest."""
    heard: list[CanFrame] = []
    ClosedLoop(vehicle(), log=heard.append)
    odd = (
        CanFrame(heard[-1].timestamp_ns + 1, 0x123, b"", extended=True),
        CanFrame(heard[-1].timestamp_ns + 2, 4, bytes(8), error=True),
        CanFrame(heard[-1].timestamp_ns + 3, 1, b"", remote=True),
    )
    return (*heard[-100:], *odd)


@cache
def log() -> bytes:
    """The frames as `candump -L` writes them."""
    return "".join(f"{format_frame(frame, 'can0')}\n" for frame in frames()).encode()


def read_log(path: Path) -> None:
    for frame in CandumpReader(path):
        assert len(frame.data) <= 64
    replay.from_raw_log(path, vehicle())


LOG_TOKENS = (
    b"R8",
    b"R99999999999",
    b"#",
    b"##1",
    b"(",
    b")",
    b"()",
    b"can1",
    b"FFFFFFFF",
    b"-1",
    b"9" * 5000,
    b".",
    b"\n",
    b" ",
    b"20000004#",
)


LOGS = {"asc": can.ASCWriter, "blf": can.BLFWriter, "trc": can.TRCWriter, "can-csv": can.CSVWriter}


@cache
def log_of(name: str) -> bytes:
    """The frames in another format, as python-can writes them."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "seed"
        with LOGS[name](path) as writer:
            for each in frames():
                writer.on_message_received(
                    can.Message(
                        timestamp=each.timestamp_ns * 1e-9,
                        arbitration_id=each.can_id,
                        data=each.data,
                        is_extended_id=each.extended,
                        is_error_frame=each.error,
                        is_remote_frame=each.remote,
                        channel=0,
                    )
                )
        return path.read_bytes()


def read_log_of_others(path: Path) -> None:
    """As a CAN log if it is one, else as the table that it then is."""
    recording = replay.load(path, vehicle())
    assert np.all(np.diff(recording.timestamp_ns) > 0)


# Bus logging


@cache
def bus_logs() -> tuple[bytes, ...]:
    """The frames as MF4, as they are, compressed, and in a file that its writer did not finalise."""
    whole = content(log_files.bus_log(*bus_frames()), ".mf4")
    packed = content(log_files.bus_log(*bus_frames(), compression=2), ".mf4")
    return whole, packed, b"UnFinMF " + whole[8:60] + b"\x05\x00" + whole[62:]


def bus_frames() -> tuple[dict[str, np.ndarray], np.ndarray]:
    """The data frames and a remote frame, and times for them."""
    heard = [each for each in frames() if not (each.error or each.remote)]
    rows = np.zeros(len(heard), dtype=[(name, kind) for name, kind in log_files.FRAME])
    for row, each in zip(rows, heard, strict=True):
        row["ID"], row["IDE"], row["DLC"], row["DataLength"] = (
            each.can_id,
            each.extended,
            len(each.data),
            len(each.data),
        )
        row["DataBytes"][: len(each.data)] = list(each.data)
    remote = np.zeros(1, dtype=[(name, kind) for name, kind in log_files.FRAME[:-1]])
    return {"CAN_DataFrame": rows, "CAN_RemoteFrame": remote}, 1e-9 * np.array([each.timestamp_ns for each in heard])


def odd_bus_logs() -> st.SearchStrategy[bytes]:
    """Bus logging with fields that are missing, of other types or of odd values."""
    kinds = st.sampled_from(("u1", "<u2", "<u8", "<i4", "<f8", "S4", "(8,)u1", "(64,)u1", "(2,)f4"))
    fields = st.dictionaries(st.sampled_from([name for name, _ in log_files.FRAME]), kinds, min_size=1)
    values = st.lists(st.sampled_from((0, 1, 8, 64, 255, 256, 0x18A, 0x7FF, 0x1FFFFFFF, 2**31, 2**64 - 1)), min_size=1)
    names = st.sampled_from(("CAN_DataFrame", "CAN_RemoteFrame"))
    return st.builds(odd_bus_log, names, fields, values, times())


def odd_bus_log(name: str, fields: dict[str, str], values: Sequence[int], clock: np.ndarray) -> bytes:
    rows = np.zeros(len(clock), dtype=list(fields.items()))
    for place, field in enumerate(fields):
        with np.errstate(all="ignore"):
            cells = np.resize(np.roll(np.array(values, dtype=np.uint64), place), rows[field].shape)
            rows[field] = cells.astype(rows[field].dtype)
    return safe(log_files.bus_log({name: rows}, clock), ".mf4")


# Compressed


def compressed(data: bytes) -> bytes:
    return gzip.compress(data, mtime=0)


@cache
def compressed_logs() -> tuple[bytes, ...]:
    """Logs of text in each format, as they are and begun anew in the middle of the file."""
    short = [log(), *(log_of(name) for name in ("asc", "trc", "can-csv"))]
    return (*map(compressed, short), compressed(log()[:1000]) + compressed(log()[1000:]))


@cache
def bomb() -> bytes:
    """A fifth of a megabyte that is a line of two hundred megabytes."""
    return compressed(log()[:1000] + bytes(200 << 20))


DBC = b"""VERSION ""
BU_: ECU
BO_ 385 Odd: 8 ECU
 SG_ Mode M : 0|4@1+ (1,0) [0|15] "" ECU
 SG_ Torque m1 : 8|16@1- (0.01,0) [-100|100] "Nm" ECU
BO_ 906 Motor: 8 ECU
 SG_ Angle : 0|16@1- (0.1,0) [-1000|1000] "deg" ECU
 SG_ Speed : 23|16@0- (1,0) [-30000|30000] "rpm" ECU
SIG_VALTYPE_ 906 Speed : 0;
CM_ SG_ 906 Angle "motor angle";
VAL_ 385 Mode 0 "off" 1 "on";
"""
DBC_PARTS = (
    b"BO_ 2147484160 ",
    b"m0",
    b"63|64@1-",
    b"(0,0)",
    b"(1e999,0)",
    b"65|1",
    b"0|0",
    b'"',
    b"SG_ Angle",
    b"906",
)


@contextmanager
def with_log(folder: Path) -> Iterator[Trial]:
    """The signals of a DBC in the frames."""
    path, database = folder / "run.log", folder / "input.dbc"
    path.write_bytes(log())

    def trial(data: bytes) -> None:
        database.write_bytes(data)
        found = signals(open_log(path), database, path)
        table_of(found)

    yield trial


def log_inputs() -> st.SearchStrategy[bytes]:
    return st.one_of(
        anything([log(), log()[:200]], LOG_TOKENS),
        exchanged(
            [log()[:1000]],
            [b"R8", b"R9", b"", b"00" * 9, b"0", b"R-1", b"R" + b"9" * 30, b"R" + b"9" * 5000, b"R999999999999"],
            b"#",
        ),
    )


TARGETS = (
    Target(
        "log",
        "a raw CAN log",
        of_file(".log", read_log),
        log_inputs,
        lambda: [log(), b"(1.000000) can0 123#R99999999999\n"],
    ),
    *(
        Target(
            name,
            f"a CAN log of another tool, {name}",
            of_file(f".{name.removeprefix('can-')}", read_log_of_others),
            lambda name=name: anything([log_of(name), log_of(name)[:1000]], FIELDS, head=500),
            lambda name=name: [log_of(name)],
            short=100,
        )
        for name in LOGS
    ),
    Target(
        "mf4-bus",
        "bus logging as MF4",
        of_file(".mf4", read_log_of_others),
        lambda: st.one_of(mutated(bus_logs()), mutated(bus_logs(), head=HEAD), odd_bus_logs()),
        bus_logs,
        seconds=5.0,
        megabytes=300,
        short=100,
    ),
    Target(
        "can-gz",
        "a CAN log that is compressed",
        of_file(".log.gz", read_log_of_others),
        lambda: st.one_of(mutated(compressed_logs()), log_inputs().map(compressed)),
        lambda: (*compressed_logs(), bomb()),
    ),
    Target(
        "dbc",
        "the messages of a CAN log",
        with_log,
        lambda: st.one_of(anything([DBC], DBC_PARTS), exchanged([DBC], DBC_PARTS, b" : ")),
        lambda: [DBC],
        short=100,
    ),
)
