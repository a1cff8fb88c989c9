"""CAN logs as other tools write them: each dialect is read and right, or refused with the remedy named.

The table is made from one raw log of the virtual vehicle, a second at rest, in every dialect.
"""

from __future__ import annotations

import gzip
import re
import struct
import subprocess
import sys
import tracemalloc
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from itertools import count
from pathlib import Path

import can
import log_files
import numpy as np
import pytest
from dialects import ANGLE

from upright.service.offline.inputs.can_log import is_can_log
from upright.service.offline.inputs.can_readers import READERS
from upright.service.offline.inputs.replay import load as load_recording
from upright.service.virtual.run import ClosedLoop
from upright.telemetry.candump import Skipped, format_frame, format_frames
from upright.telemetry.errors import RecordingError
from upright.telemetry.recording import Recording
from upright.telemetry.samples import CanFrame
from upright.vehicles.file import load

VEHICLE = load("monocab")
START_NS = 1_730_301_035_000_000_000
CHANNELS = ("roll", "roll_rate", "precession", "precession_rate", "trim_position")
Lines = Callable[[CanFrame], str]


@pytest.fixture(scope="module")
def frames() -> list[CanFrame]:
    return heard_frames()


def heard_frames() -> list[CanFrame]:
    """A second of the bus, with times in whole microseconds and all frames in their order, as one socket gives them."""
    heard: list[CanFrame] = []
    ClosedLoop(VEHICLE, log=heard.append).advance(1.0)
    heard = sorted((frame for frame in heard if frame.timestamp_ns), key=lambda frame: frame.timestamp_ns)
    return [replace(frame, timestamp_ns=START_NS + frame.timestamp_ns // 1000 * 1000) for frame in heard]


@pytest.fixture(scope="module")
def right(frames: list[CanFrame], tmp_path_factory: pytest.TempPathFactory) -> Recording:
    """What the log holds, from the format that upright writes."""
    log = tmp_path_factory.mktemp("right") / "run.log"
    log.write_text(format_frames(frames, ("can0",)))
    return load_recording(log, VEHICLE)


# Text


def logged(frame: CanFrame, tail: str = "", channel: str = "can0") -> str:
    """As `candump -L`: microseconds."""
    seconds, rest = divmod(frame.timestamp_ns // 1000, 1_000_000)
    return f"({seconds}.{rest:06d}) {channel} {frame.can_id:03X}#{frame.data.hex().upper()}{tail}\n"


def shown(frame: CanFrame, *, flags: str = "", tail: str = "", data: str | None = None, stamp: str = "") -> str:
    """As `candump -ta`."""
    seconds, rest = divmod(frame.timestamp_ns // 1000, 1_000_000)
    data = frame.data.hex(" ").upper() if data is None else data
    stamp = stamp or f"({seconds}.{rest:06d})"
    return f" {stamp}  can0  {flags}{frame.can_id:03X}   [{len(frame.data)}]  {data}{tail}\n"


def since_start(frame: CanFrame) -> float:
    return (frame.timestamp_ns - START_NS) * 1e-9


def as_float(frame: CanFrame) -> str:
    return logged(frame).replace(logged(frame).split(")")[0], f"({since_start(frame)!r}")


def as_date(frame: CanFrame) -> str:
    whole = datetime.fromtimestamp(frame.timestamp_ns // 1_000_000_000, UTC)
    return shown(frame, stamp=f"({whole:%Y-%m-%d %H:%M:%S}.{frame.timestamp_ns // 1000 % 1_000_000:06d})")


def in_ascii(frame: CanFrame) -> str:
    return shown(frame, tail=f"   '{''.join(chr(byte) if 32 <= byte < 127 else '.' for byte in frame.data)}'")


def swapped(frame: CanFrame) -> str:
    return shown(frame, data="`".join(f"{byte:02X}" for byte in reversed(frame.data)))


def in_binary(frame: CanFrame) -> str:
    return shown(frame, data=" ".join(f"{byte:08b}" for byte in frame.data))


def coloured(frame: CanFrame) -> str:
    return f"\x1b[31m{shown(frame).rstrip()}\x1b[0m\n"


def every(lines: Lines, *more: str) -> Lines:
    """Further lines after every 500th, with its time in place of TIME."""
    number = count(1)

    def with_more(frame: CanFrame) -> str:
        added = "".join(more).replace("TIME", logged(frame)[1:].partition(")")[0]) if next(number) % 500 == 0 else ""
        return lines(frame) + added

    return with_more


def text(
    lines: Lines, encoding: str = "utf-8", head: str = "", tail: str = "", pack: Callable[[bytes], bytes] = bytes
) -> Callable[[Sequence[CanFrame], Path], None]:
    def write(frames: Sequence[CanFrame], path: Path) -> None:
        path.write_bytes(pack((head + "".join(map(lines, frames)) + tail).encode(encoding)))

    return write


def between(frames: Sequence[CanFrame], path: Path) -> None:
    """As `candump -td`: the time since the frame before, in microseconds."""
    lines, before = [], frames[0].timestamp_ns
    for frame in frames:
        step, before = frame.timestamp_ns - before, frame.timestamp_ns
        lines.append(shown(frame, stamp=f"({step // 10**9:03d}.{step // 1000 % 10**6:06d})"))
    path.write_text("".join(lines))


def set_back(frames: Sequence[CanFrame], path: Path) -> None:
    """NTP sets the clock back by 0.5 s in the middle."""
    half = frames[len(frames) // 2].timestamp_ns
    moved = [replace(f, timestamp_ns=f.timestamp_ns - 500_000_000 * (f.timestamp_ns >= half)) for f in frames]
    path.write_text("".join(map(logged, moved)))


def twice(frames: Sequence[CanFrame], path: Path) -> None:
    """Two recordings with times from their start, one after the other."""
    zero = [replace(frame, timestamp_ns=frame.timestamp_ns - frames[0].timestamp_ns) for frame in frames]
    path.write_text("".join(map(logged, [*zero, *zero])))


def beside_another_vehicle(frames: Sequence[CanFrame], path: Path) -> None:
    """A second interface carries frames with the same ids and other contents, a little out of order."""
    path.write_text(
        "".join(
            logged(
                replace(frame, data=bytes(len(frame.data)), timestamp_ns=frame.timestamp_ns + 300_000), channel="can7"
            )
            + logged(frame)
            for frame in frames
        )
    )


def over_two_interfaces(frames: Sequence[CanFrame], path: Path) -> None:
    """IMU and drives on a bus each."""
    imu = {0x18A, 0x28A, 0x38A}
    path.write_text("".join(logged(f, channel="slcan1" if f.can_id in imu else "slcan0") for f in frames))


# Files of other tools


def messages(frames: Iterable[CanFrame], start_ns: int = 0) -> Iterable[can.Message]:
    for frame in frames:
        yield can.Message(
            timestamp=(frame.timestamp_ns - start_ns) * 1e-9,
            arbitration_id=frame.can_id,
            is_extended_id=frame.extended,
            data=frame.data,
            channel=0,
        )


def written_by(
    writer: Callable[..., can.Listener], change: Callable[[bytes], bytes] = bytes, **options: object
) -> Callable[[Sequence[CanFrame], Path], None]:
    def write(frames: Sequence[CanFrame], path: Path) -> None:
        with writer(path, **options) as file:  # type: ignore[attr-defined]
            for message in messages(frames):
                file.on_message_received(message)
        path.write_bytes(change(path.read_bytes()))

    return write


def trc(version: str, line: Callable[[int, float, CanFrame], str], columns: str = "") -> object:
    def write(frames: Sequence[CanFrame], path: Path) -> None:
        head = f";$FILEVERSION={version}\n;$STARTTIME=45595.6485562986\n{columns};   Message Number\n"
        rows = [
            line(number, (frame.timestamp_ns - frames[0].timestamp_ns) * 1e-6, frame)
            for number, frame in enumerate(frames, start=1)
        ]
        path.write_text(head + "".join(rows))

    return write


def trc_1_1(number: int, ms: float, frame: CanFrame) -> str:
    data = frame.data.hex(" ").upper()
    return f"{number:6d}){ms:12.3f}  Rx    {frame.can_id:08X}  {len(frame.data)}  {data}\n".replace(
        "    0000", "        "
    )


def trc_1_0(number: int, ms: float, frame: CanFrame) -> str:
    return f"{number:6d}){ms:11.3f}  {frame.can_id:04X}  {len(frame.data)}  {frame.data.hex(' ').upper()}\n"


def trc_1_3(number: int, ms: float, frame: CanFrame) -> str:
    return f"{number:6d}){ms:14.3f} 1  Rx  {frame.can_id:04X} -  {len(frame.data)}  {frame.data.hex(' ').upper()}\n"


def trc_2_0(number: int, ms: float, frame: CanFrame) -> str:
    return f"{number:6d} {ms:13.3f} DT {frame.can_id:04X} Rx {len(frame.data)}  {frame.data.hex(' ').upper()}\n"


def with_commas(line: Callable[[int, float, CanFrame], str]) -> Callable[[int, float, CanFrame], str]:
    return lambda number, ms, frame: line(number, ms, frame).replace(".", ",")


def trc_1_2(number: int, ms: float, frame: CanFrame) -> str:
    return f"{number:6d}){ms:14.3f} 1  Rx  {frame.can_id:04X}  {len(frame.data)}  {frame.data.hex(' ').upper()}\n"


def trc_2_1(number: int, ms: float, frame: CanFrame) -> str:
    return f"{number:6d} {ms:13.3f} DT 1 {frame.can_id:04X} Rx - {len(frame.data)}  {frame.data.hex(' ').upper()}\n"


def asc_of_canoe(stamps: str, *, base: str = "hex", comma: bool = False) -> object:
    """An ASC file with what CANoe writes beside the frames, in German."""

    def write(frames: Sequence[CanFrame], path: Path) -> None:
        lines = [
            "date Mi Okt 30 15:10:35.000 2024",
            f"base {base}  timestamps {stamps}",
            "internal events logged",
            "// version 13.0.0 für den Prüfstand",
            "   0.000000 Start of measurement",
        ]
        number_of = "{:X}".format if base == "hex" else str
        before = frames[0].timestamp_ns
        for number, frame in enumerate(frames):
            time = (frame.timestamp_ns - (before if stamps == "relative" else frames[0].timestamp_ns)) * 1e-9
            before = frame.timestamp_ns
            data = " ".join(map(number_of, frame.data))
            line = f"   {time:.6f} 1  {number_of(frame.can_id)}      Rx   d {len(frame.data)} {data}  Length = 245910"
            lines.append(line.replace(".", ",", 1) if comma else line)
            if number % 500 == 0:
                zero = 0.0 if stamps == "relative" else time
                lines.append(f"   {zero:.6f} CAN 1 Status:chip status error active")
                lines.append(f"   {zero:.6f} 1  Statistic: D 50 R 0 XD 0 XR 0 E 0 O 0 B 10.00%")
                lines.append(f"   {zero:.6f} 1  ErrorFrame")
        path.write_bytes("\n".join(lines).encode("cp1252"))

    return write


BUS_LOGGING = """
import sys
import can
with can.Logger(sys.argv[2]) as file:
    for message in can.LogReader(sys.argv[1]):
        file(message)
"""


def mf4(frames: Sequence[CanFrame], path: Path) -> None:
    """By python-can, in a process in which it finds asammdf (see `drivers`)."""
    blf = path.with_suffix(".blf")
    written_by(can.BLFWriter)(frames, blf)
    subprocess.run([sys.executable, "-W", "ignore", "-c", BUS_LOGGING, blf, path], check=True)


def damaged(data: bytes, place: int) -> bytes:
    """With some bytes of no sense."""
    return data[:place] + b"\xff" * 64 + data[place + 64 :]


def wrong_bytes(data: bytes) -> bytes:
    """The last container of a BLF with bytes that are no frames."""
    return data[: len(data) * 3 // 4]


@dataclass(frozen=True)
class Dialect:
    """A log that somebody may have. `notes`: what is said of it; `refused`: words of the refusal, if it is refused.
    `frames_lost`: samples that may be missing, at most."""

    name: str
    write: object
    suffix: str = ".log"
    notes: str = ""
    refused: str = ""
    samples_lost: int = 0


FD_NODE = "(TIME) can0 7A0##1" + 12 * "00" + "\n"

READ = [
    Dialect("candump -L", text(logged)),
    Dialect("nanoseconds", text(lambda frame: format_frame(frame, "can0") + "\n")),
    Dialect("python-can and can-utils since 2020: R or T", text(lambda frame: logged(frame, " T"))),
    Dialect("python-can's own writer", written_by(can.CanutilsLogWriter)),
    Dialect("python-can's own writer, compressed", written_by(can.CanutilsLogWriter, gzip.compress), ".log.gz"),
    Dialect("candump -L -tz", text(lambda frame: logged(replace(frame, timestamp_ns=frame.timestamp_ns - START_NS)))),
    Dialect("times as Python prints floats", text(as_float)),
    Dialect("candump -ta", text(shown)),
    Dialect("candump -ta, another suffix", text(shown), ".txt"),
    Dialect("candump -tA", text(as_date)),
    Dialect("candump -td", between, notes="those between two frames"),
    Dialect("candump -ta -x", text(lambda frame: shown(frame, flags="RX B -  "))),
    Dialect("candump -ta -a", text(in_ascii)),
    Dialect("candump -ta -S", text(swapped)),
    Dialect("candump -ta -i", text(in_binary)),
    Dialect("candump -ta -c", text(coloured)),
    Dialect("what python-can prints", text(lambda frame: f"{next(iter(messages([frame])))}\n"), ".txt"),
    Dialect("CRLF", text(lambda frame: logged(frame).replace("\n", "\r\n"))),
    Dialect("lower case", text(lambda frame: logged(frame).lower())),
    Dialect("two blanks", text(lambda frame: logged(frame).replace(" ", "  "))),
    Dialect("UTF-8 with its mark", text(logged, "utf-8-sig")),
    Dialect("UTF-16, as PowerShell redirects", text(logged, "utf-16")),
    Dialect("comments", text(logged, head="# recorded on the track\n\n", tail="// end\n")),
    Dialect("a CAN FD node", text(every(logged, FD_NODE))),
    Dialect("a CAN FD node, shown", text(every(shown, " (TIME)  can0  7A0  [12] " + 12 * " 00" + "\n"))),
    Dialect("raw length codes", text(every(logged, "(TIME) can0 5A1#1122334455667788_B\n"))),
    Dialect("dots between bytes", text(every(logged, "(TIME) can0 5A1#11.22.33.44\n"))),
    Dialect(
        "error and remote frames",
        text(every(logged, *(f"(TIME) can0 {each}\n" for each in ("20000004#0004000000000000", "123#R8", "123#R")))),
    ),
    Dialect(
        "error and remote frames, shown",
        text(
            every(
                shown,
                " (TIME)  can0  20000004   [8]  00 04 00 00 00 00 00 00   ERRORFRAME\n\tcontroller\n",
                " (TIME)  can0  123   [8]  remote request\n",
            )
        ),
        notes="lines are no CAN frames",
    ),
    Dialect(
        "a line that is none", text(logged, head="Interface can0 is up\n"), notes=r"1 line is no CAN frame.*line 1"
    ),
    Dialect(
        "lines cut in the middle", text(every(logged, "(173030\n", "can0 18A#0\n")), notes="lines are no CAN frames"
    ),
    Dialect("an id that is none", text(every(logged, "(TIME) can0 FFF#00\n")), notes="FFF is not a CAN id"),
    Dialect(
        "bytes that are no text",
        text(logged, "latin-1", head="\xff\xfe\x00\x01 Fahrt über den Hof\n".replace("\xff\xfe", "\xe4\xf6")),
        notes="no CAN frame",
    ),
    Dialect("the last line cut off", text(logged, tail="(1730301036.9 can0 18A#00"), notes="cut off"),
    Dialect("the clock set back", set_back, notes=r"set back by 0\.5"),
    Dialect("a frame of 1970", text(every(logged, "(0.000000) can0 701#00\n")), notes="701h -17303020.* s away"),
    Dialect("a frame of 2030", text(every(logged, "(1893456000.000000) can0 701#00\n")), notes="s away"),
    Dialect("two recordings in one", twice, notes="begin again"),
    Dialect(
        "another vehicle on can7", beside_another_vehicle, notes="are on can0 and can7: can0 is read|can7 and can0"
    ),
    Dialect("IMU and drives on a bus each", over_two_interfaces),
    Dialect("ASC by python-can", written_by(can.ASCWriter), ".asc"),
    Dialect("ASC by CANoe", asc_of_canoe("absolute"), ".asc"),
    Dialect("ASC by CANoe, decimal commas", asc_of_canoe("absolute", comma=True), ".asc"),
    Dialect("ASC by CANoe, decimal numbers", asc_of_canoe("absolute", base="dec"), ".asc"),
    Dialect("ASC with relative times", asc_of_canoe("relative"), ".asc"),
    Dialect(
        "ASC with a wrong line",
        written_by(can.ASCWriter, lambda data: data.replace(b"\n", b"\n 0.1 1 18A Rx d 8 00 XX\n", 9)),
        ".asc",
        notes="no CAN frame",
    ),
    Dialect("BLF by python-can", written_by(can.BLFWriter), ".blf"),
    Dialect("BLF named .log", written_by(can.BLFWriter)),
    Dialect("BLF cut off", written_by(can.BLFWriter, wrong_bytes), ".blf", notes="", samples_lost=1000),
    Dialect("TRC by python-can", written_by(can.TRCWriter), ".trc"),
    Dialect("TRC 1.0", trc("1.0", trc_1_0), ".trc"),
    Dialect("TRC 1.1", trc("1.1", trc_1_1), ".trc"),
    Dialect("TRC 1.1 with decimal commas", trc("1.1", with_commas(trc_1_1)), ".trc"),
    Dialect("TRC 1.3", trc("1.3", trc_1_3), ".trc"),
    Dialect("TRC 2.0", trc("2.0", trc_2_0, ";$COLUMNS=N,O,T,I,d,l,D\n"), ".trc"),
    Dialect(
        "TRC with a wrong line",
        trc("1.1", lambda n, ms, frame: trc_1_1(n, ms, frame) + ("  7) bad\n" if n % 500 == 0 else "")),
        ".trc",
        notes="no CAN frame",
    ),
    Dialect("TRC 1.2", trc("1.2", trc_1_2), ".trc"),
    Dialect("TRC 2.1", trc("2.1", trc_2_1, ";$COLUMNS=N,O,T,B,I,d,R,L,D\n"), ".trc"),
    Dialect("CSV by python-can", written_by(can.CSVWriter), ".csv"),
    Dialect("MF4 bus logging", mf4, ".mf4"),
]

REFUSED = [
    Dialect("no times", text(lambda frame: shown(frame, stamp=" ").lstrip()), refused="no times.*candump -L"),
    Dialect("empty", text(lambda frame: ""), refused="no complete sample"),
    Dialect("no line is one", text(lambda frame: "hello\n"), refused="line 1.*Expected lines as"),
    Dialect(
        "another vehicle's",
        text(lambda f: logged(replace(f, can_id=f.can_id ^ 0x400))),
        refused=r"it holds the ids .*58Ah.*\[imu\]",
    ),
    Dialect("a BLF of nothing", written_by(can.BLFWriter, lambda data: data[:60]), ".blf", refused="Export it again"),
    Dialect(
        "TRC of another century",
        written_by(can.TRCWriter, lambda data: re.sub(rb"STARTTIME=[\d.]+", b"STARTTIME=255569.01", data)),
        ".trc",
        refused="no time of this century",
    ),
    Dialect("text named .blf", text(lambda frame: "hello\n"), ".blf", refused="line 1"),
    Dialect(
        "a compressed log cut off",
        text(logged, pack=lambda data: gzip.compress(data)[:90]),
        refused="cannot be read.*zcat",
    ),
    Dialect(
        "a compressed log that is damaged",
        text(logged, pack=lambda data: damaged(gzip.compress(data), 20)),
        refused="cannot be read.*Copy it again",
    ),
    Dialect(
        "a compressed log that is damaged in its middle",
        text(logged, pack=lambda data: damaged(gzip.compress(data), len(data) // 10)),
        refused="cannot be read.*Copy it again",
    ),
]


def made(dialect: Dialect, frames: Sequence[CanFrame], folder: Path) -> Path:
    path = folder / f"run{dialect.suffix}"
    dialect.write(frames, path)  # type: ignore[operator]
    return path


@pytest.mark.parametrize("dialect", READ, ids=lambda dialect: dialect.name)
def test_log_is_read_and_right(dialect: Dialect, frames: list[CanFrame], right: Recording, tmp_path: Path) -> None:
    path = made(dialect, frames, tmp_path)
    assert is_can_log(path)
    found = load_recording(path, VEHICLE)
    assert len(right) - dialect.samples_lost <= len(found) <= len(right)
    for name in CHANNELS:
        np.testing.assert_allclose(found[name], right[name][: len(found)], atol=2e-6, err_msg=name)
    np.testing.assert_allclose(found.time, right.time[: len(found)], atol=2e-3 if dialect.samples_lost else 2e-6)
    assert re.search(dialect.notes, found.truncated), found.truncated
    if not dialect.notes:
        assert "left out" not in found.truncated


@pytest.mark.parametrize("dialect", REFUSED, ids=lambda dialect: dialect.name)
def test_log_is_refused_with_the_remedy(dialect: Dialect, frames: list[CanFrame], tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match=dialect.refused) as caught:
        load_recording(made(dialect, frames, tmp_path), VEHICLE)
    assert caught.value.remedy


DBC = """VERSION ""
NS_ :
BS_:
BU_: ECU
BO_ 256 Motor: 8 ECU
 SG_ Angle : 0|16@1- (0.1,0) [-1000|1000] "deg" ECU
 SG_ Speed : 16|16@1- (1,0) [-30000|30000] "rpm" ECU
 SG_ Torque : 32|16@1- (0.01,0) [-100|100] "Nm" ECU
BO_ 2147484160 Supply: 2 ECU
 SG_ Voltage : 0|16@1+ (1,0) [0|65535] "mV" ECU
CM_ SG_ 256 Angle "motor angle, für alle";
"""


def motor_log(folder: Path) -> Path:
    """Two messages: the motor every 5 ms, its supply (an extended id) every 20 ms, from the third on."""
    heard = []
    for place in range(100):
        data = struct.pack("<hhh", 10 * place, 60, -250) + bytes(2)
        heard.append(CanFrame(START_NS + 5_000_000 * place, 0x100, data))
        if place % 4 == 2:
            heard.append(
                CanFrame(START_NS + 5_000_000 * place, 0x200, struct.pack("<H", 24_000 + place), extended=True)
            )
    log = folder / "motor.log"
    log.write_text(format_frames(heard, ("can0",)))
    return log


def test_signals_of_a_dbc_are_channels_in_si(tmp_path: Path) -> None:
    database = tmp_path / "motor.dbc"
    database.write_text(DBC, "cp1252")
    found = load_recording(motor_log(tmp_path), VEHICLE, database)
    assert {channel.name: channel.unit for channel in found.channels} == {
        "Angle": "rad", "Speed": "rad/s", "Torque": "N m", "Voltage": "V"
    }  # fmt: skip
    assert found.rate == pytest.approx(200.0)
    np.testing.assert_allclose(found["Angle"], np.radians(np.arange(100.0)), atol=1e-12)
    np.testing.assert_allclose(found["Speed"], 2.0 * np.pi)
    np.testing.assert_allclose(found["Torque"], -2.5)
    assert np.isnan(found["Voltage"][:2]).all()
    np.testing.assert_allclose(found["Voltage"][2:6], 24.002)
    np.testing.assert_allclose(found["Voltage"][6], 24.006)
    assert found.truncated == ""


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (DBC.replace("BO_ 256", "BO_ 255").replace("SG_ 256", "SG_ 255").replace("2147484160", "2147484161"),
         "holds no message of .*100h, 200h.*Name the DBC of this bus"),
        ("hello", "is no DBC that can be read.*Export it again"),
        ('VERSION ""\n', "holds no messages.*Name the DBC"),
        (None, "No such file.*Check the path"),
    ],
)  # fmt: skip
def test_wrong_dbc_is_refused_with_the_remedy(tmp_path: Path, content: str | None, words: str) -> None:
    database = tmp_path / "other.dbc"
    if content is not None:
        database.write_text(content)
    with pytest.raises(RecordingError, match=words):
        load_recording(motor_log(tmp_path), VEHICLE, database)


@pytest.mark.parametrize(("package", "extra"), [("cantools", "dbc"), ("asammdf", "mf4")])
def test_missing_package_error_names_the_extra(
    package: str, extra: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    log = motor_log(tmp_path)
    bus = tmp_path / "bus.mf4"
    bus.write_bytes(b"MDF     4.10    " + bytes(100))
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(RecordingError, match=rf"needs the package {package}.*upright\[{extra}\]"):
        load_recording(*((log, VEHICLE, tmp_path / "motor.dbc") if extra == "dbc" else (bus, VEHICLE)))


def test_damaged_measurement_file_is_no_log_and_asammdf_stays_silent(tmp_path: Path) -> None:
    """asammdf complains of its half-made objects when they go, which the tests take for an error."""
    path = tmp_path / "run.mf4"
    log_files.mf4({"angle": (ANGLE, "rad")})(path)
    path.write_bytes(path.read_bytes()[:9000])
    assert not is_can_log(path)


def test_damaged_bus_log_leaves_no_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """asammdf copies a file that was not finalised, and forgets the copy where it cannot read it."""
    log, database, temporary = tmp_path / "run.mf4", tmp_path / "motor.dbc", tmp_path / "temporary"
    log_files.mf4({"angle": (ANGLE, "rad")})(log)
    log.write_bytes(b"UnFinMF " + log.read_bytes()[8:60] + b"\x05\x00" + bytes(2900))
    database.write_text(DBC, "cp1252")
    temporary.mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(temporary))
    with pytest.raises(RecordingError, match=r"is no CAN log that can be read.*Export it again"):
        load_recording(log, VEHICLE, database)
    assert not list(temporary.iterdir())


@pytest.mark.parametrize("writer", [can.ASCWriter, can.TRCWriter])
def test_log_is_read_line_by_line(writer: Callable[..., can.Listener], frames: list[CanFrame], tmp_path: Path) -> None:
    """A log of an hour is larger than the memory of a small computer."""
    path = tmp_path / f"run.{writer.__name__[:3].lower()}"
    written_by(writer)(frames, path)
    skipped = Skipped()
    tracemalloc.start()
    read = sum(1 for _ in READERS[path.suffix[1:]](path, skipped))
    _, most = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert read == len(frames)
    assert most < 0.5 * path.stat().st_size
