"""Every format of other programs: read with the right values, and said what was assumed, or refused with the remedy."""

from __future__ import annotations

import struct
import sys
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import log_files as files
import numpy as np
import pytest
from dialects import ANGLE, COUNT, TIME, VOLTAGE

from upright.service.offline.inputs.can_log import is_can_log
from upright.telemetry.errors import RecordingError
from upright.telemetry.formats.files import FORMATS
from upright.telemetry.recording import Recording
from upright.telemetry.storage import load
from upright.telemetry.tables.mapping import said_of
from upright.telemetry.tables.wanted import Wanted

WANTED = (Wanted("voltage", "V", held=True), Wanted("angle", "rad", measured=True))
BY_PATH = ("voltage=/command/data", "angle=/joint_states/pivot/position")
BOTH = {"voltage": (VOLTAGE, "V"), "angle": (ANGLE, "rad")}
TURNED = {"voltage": (VOLTAGE, "V"), "angle": (np.degrees(ANGLE), "deg")}
SLOWER = np.arange(0, COUNT, 2)


@dataclass(frozen=True)
class Case:
    """A file, with what is said of it; `limit` are the absolute limits of what a format rounds."""

    name: str
    suffix: str
    write: files.Write
    says: str = ""
    maps: tuple[str, ...] = ()
    limit: float = 1e-9
    time_limit: float = 1e-8
    rows: np.ndarray | None = None
    metadata: tuple[str, str] | None = None


CASES = (
    Case("MCAP, JSON", ".mcap", files.mcap_json(files.one_topic), "/pendulum: time when each message was logged"),
    Case("MCAP, two topics", ".mcap", files.mcap_json(files.two_topics), "voltage held"),
    Case("MCAP, lz4", ".mcap", files.mcap_json(files.two_topics, "lz4"), "voltage held"),
    Case("MCAP, not compressed", ".mcap", files.mcap_json(files.two_topics, "none"), "voltage held"),
    Case("MCAP under another name", ".bin", files.mcap_json(files.two_topics), "voltage held"),
    Case("MCAP, ROS 2", ".mcap", files.file_of_rosbag2("mcap"), "/joint_states: time of header.stamp", BY_PATH),
    Case("rosbag 2, folder of MCAP", "", files.rosbag2("mcap"), "/joint_states: time of header.stamp", BY_PATH),
    Case("rosbag 2, folder of SQLite", "", files.rosbag2("sqlite3"), "/command: time when each message", BY_PATH),
    Case("rosbag 2, without definitions", "", files.rosbag2("sqlite3", 8), "header.stamp", BY_PATH),
    Case("rosbag 2, compressed messages", "", files.rosbag2("sqlite3", packed="message"), "header.stamp", BY_PATH),
    Case("rosbag 2, compressed files", "", files.rosbag2("sqlite3", packed="file"), "header.stamp", BY_PATH),
    Case("rosbag 2, file of SQLite", ".db3", files.file_of_rosbag2("sqlite3"), "header.stamp", BY_PATH),
    Case("rosbag 2, another clock", "", files.rosbag2("mcap", stamped=False), "is of another clock", BY_PATH),
    Case("rosbag 1", ".bag", files.rosbag1(), "/joint_states: time of header.stamp", BY_PATH),
    Case("rosbag 1, bz2", ".bag", files.rosbag1("bz2"), "header.stamp", BY_PATH),
    Case("rosbag 1, lz4", ".bag", files.rosbag1("lz4"), "header.stamp", BY_PATH),
    Case("rosbag 1, another clock", ".bag", files.rosbag1(stamped=False), "is of another clock", BY_PATH),
    Case(
        "ULog",
        ".ulg",
        files.ulog,
        "angle: column '/encoder[0]/angle[0]'",
        ("angle=/encoder[0]/angle[0]",),
        limit=1e-6,
        metadata=("sys_name", "bench"),
    ),
    Case("dataflash", ".bin", files.dataflash, "angle: deg, converted", ("angle=/ENC[0]/angle",), limit=1e-6),
    Case("MF4", ".mf4", files.mf4(BOTH)),
    Case("MF4, degrees", ".mf4", files.mf4(TURNED), "angle: deg, converted to rad"),
    Case("MDF 3", ".mdf", files.mf4(BOTH, version="3.30")),
    Case(
        "MF4, two groups",
        ".mf4",
        files.mf4({"voltage": BOTH["voltage"]}, {"angle": (ANGLE[SLOWER], "rad")}, times=(TIME, TIME[SLOWER])),
        "voltage averaged",
        rows=SLOWER,
    ),
    Case(
        "MF4, texts",
        ".mf4",
        files.mf4({**BOTH, "state": (np.array([b"RUN"] * COUNT), "")}),
        "left out: state",
    ),
    Case("MAT 5, rows", ".mat", files.mat5({"time": TIME, "voltage": VOLTAGE, "angle": ANGLE})),
    Case("MAT 5, columns", ".mat", files.mat5({"t": TIME, "voltage": VOLTAGE, "angle": ANGLE}, oned_as="column")),
    Case("MAT 4", ".mat", files.mat5({"time": TIME, "voltage": VOLTAGE, "angle": ANGLE}, format="4")),
    Case(
        "MAT 5, compressed, parameters beside",
        ".mat",
        files.mat5(
            {"J": 0.45, "time_ms": 1000 * TIME, "voltage": VOLTAGE, "angle_deg": np.degrees(ANGLE), "gain": [1.0, 2.0]},
            do_compression=True,
        ),
        "left out: gain",
    ),
    Case("MAT 5, struct", ".mat", files.mat5({"run": {"time": TIME, "voltage": VOLTAGE, "angle": ANGLE}})),
    Case("MAT 5, struct with t", ".mat", files.mat5({"run": {"t": TIME, "voltage": VOLTAGE, "angle": ANGLE}})),
    Case(
        "MAT 5, struct beside the time",
        ".mat",
        files.mat5({"tout": TIME, "out": {"voltage": VOLTAGE, "pivot": {"angle": ANGLE}}}),
        "angle: column 'out/pivot/angle'",
    ),
    Case("MAT 5, structure with time", ".mat", files.mat5(files.structure_with_time())),
    Case(
        "MAT 5, matrix",
        ".mat",
        files.mat5({"ans": np.stack([TIME, VOLTAGE, ANGLE])}),
        "time: column column1",
        ("voltage=column2", "angle=column3"),
    ),
    Case("MAT 7, timeseries", ".mat", files.objects(files.two_series, "v7")),
    Case("MAT 7.3, timeseries", ".mat", files.objects(files.two_series, "v7.3")),
    Case("MAT 7.3, timeseries in degrees", ".mat", files.objects(files.degrees_series, "v7.3"), "deg, converted"),
    Case("MAT 7.3, minutes beside seconds", ".mat", files.objects(files.minutes_beside_seconds, "v7.3")),
    Case("MAT 7.3, timetable", ".mat", files.objects(files.timetable, "v7.3")),
    Case("MAT 7, Dataset", ".mat", files.objects(files.dataset, "v7")),
    Case("MAT 7.3, Dataset", ".mat", files.objects(files.dataset, "v7.3")),
    Case("MAT 7.3", ".mat", files.mat73({"time": TIME, "voltage": VOLTAGE, "angle": ANGLE})),
    Case("MAT 7.3, struct", ".mat", files.mat73({"time": TIME, "voltage": VOLTAGE, "angle": ANGLE}, "run")),
    Case(
        "PlotJuggler",
        ".csv",
        lambda path: path.write_bytes(files.plotjuggler()) and None,
        "several rates in one table",
        BY_PATH,
        time_limit=1e-6,
    ),
)


@pytest.fixture(autouse=True)
def leaves_no_file(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """No reader leaves anything in the folder for temporary files, whether the file is read or refused."""
    folder = tmp_path_factory.mktemp("temporary")
    monkeypatch.setattr("tempfile.tempdir", str(folder))
    yield
    assert not list(folder.iterdir())


def opened(case: Case, folder: Path) -> Recording:
    path = folder / f"run{case.suffix}"
    case.write(path)
    return load(path, WANTED, said_of(case.maps, ()))


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_format_is_read_right(case: Case, tmp_path: Path) -> None:
    found = opened(case, tmp_path)
    rows = np.arange(COUNT) if case.rows is None else case.rows
    assert len(found) == len(rows)
    np.testing.assert_allclose(found.time, TIME[rows], rtol=0.0, atol=case.time_limit)
    np.testing.assert_allclose(found["angle"], ANGLE[rows], rtol=0.0, atol=case.limit)
    if case.rows is None:
        np.testing.assert_allclose(found["voltage"], VOLTAGE, rtol=0.0, atol=case.limit)
    else:  # averaged until the next row
        np.testing.assert_allclose(found["voltage"][:-1], (VOLTAGE[rows] + VOLTAGE[rows + 1])[:-1] / 2.0, atol=1e-9)
    assert case.says in "; ".join(found.assumed)
    assert not found.truncated
    if case.metadata is not None:
        assert found.metadata[case.metadata[0]] == case.metadata[1]


BINARY = [each for each in CASES if each.suffix not in ("", ".csv")]


@pytest.mark.parametrize("share", [0.02, 0.31, 0.7, 0.99])
@pytest.mark.parametrize(
    "case", [each for each in CASES if each.suffix not in ("", ".csv")], ids=lambda case: case.name
)
def test_file_that_is_cut_off_is_read_up_to_there_or_refused(case: Case, share: float, tmp_path: Path) -> None:
    path = tmp_path / f"run{case.suffix}"
    case.write(path)
    content = path.read_bytes()
    path.write_bytes(content[: int(share * len(content))])
    found = read_or_refused(path, case)
    if found is not None:
        whole = ANGLE if case.rows is None else ANGLE[case.rows]
        np.testing.assert_allclose(found["angle"], whole[: len(found)], rtol=0.0, atol=case.limit)
        assert found.truncated


def read_or_refused(path: Path, case: Case) -> Recording | None:
    """None if it is refused with a remedy."""
    try:
        return load(path, WANTED, said_of(case.maps, ()))
    except RecordingError as refused:
        if not refused.remedy:
            raise
    return None


UNFINALISED = b"\x05\x00"
"""The number of records and the length of the last block are to be found by the reader."""


@pytest.mark.parametrize("size", [None, 9000, 3000, 200], ids=lambda size: f"{size} bytes" if size else "whole")
def test_measurement_file_that_was_not_finalised_is_read_or_refused(size: int | None, tmp_path: Path) -> None:
    """asammdf reads a copy of it, which it forgets where it fails: see `leaves_no_file`."""
    case = next(each for each in CASES if each.name == "MF4")
    path = tmp_path / "run.mf4"
    case.write(path)
    content = path.read_bytes()
    path.write_bytes((b"UnFinMF " + content[8:60] + UNFINALISED + content[62:])[:size])
    found = read_or_refused(path, case)
    assert (found is not None) == (size is None)
    assert not is_can_log(path)


SUFFIXES = sorted(
    {suffix for each in FORMATS for suffix in each.suffixes} - {".csv", ".txt", ".tsv", ".dat", ".lvm", ".tab"}
)


@pytest.mark.parametrize("content", [b"", b"time,voltage,angle\n0,1,2\n", bytes(4096)], ids=["empty", "table", "zeros"])
@pytest.mark.parametrize("suffix", SUFFIXES)
def test_other_content_under_the_suffix_is_refused(suffix: str, content: bytes, tmp_path: Path) -> None:
    path = tmp_path / f"run{suffix}"
    path.write_bytes(content)
    with pytest.raises(RecordingError) as caught:
        load(path, WANTED)
    assert caught.value.remedy


def packed(content: bytes) -> bytes:
    """The first variable of a MAT file as a compressed one."""
    size = struct.unpack_from("<I", content, 132)[0]
    whole = zlib.compress(content[128 : 136 + size])
    return content[:128] + struct.pack("<II", 15, len(whole)) + whole


def cells(depth: int) -> dict[str, Any]:
    """Cells inside of each other."""
    found: Any = 1.0
    for _ in range(depth):
        inner, found = found, np.empty((1, 1), dtype=object)
        found[0, 0] = inner
    return {"time": TIME, "angle": ANGLE, "deep": found}


class TestDamagedMat:
    """What would end the interpreter inside of scipy is found before it reads the file."""

    @pytest.mark.parametrize("kind", [0, 8, 14, 19, 1000])
    @pytest.mark.parametrize("pack", [bytes, packed])
    @pytest.mark.parametrize("content", [{"time": TIME}, {"run": {"time": TIME}}], ids=["vector", "struct"])
    def test_type_that_is_none_is_refused(
        self, content: dict[str, Any], pack: Callable[[bytes], bytes], kind: int, tmp_path: Path
    ) -> None:
        path = tmp_path / "run.mat"
        files.mat5(content)(path)
        right = struct.pack("<II", 9, 8 * COUNT)
        assert right in path.read_bytes()
        path.write_bytes(pack(path.read_bytes().replace(right, struct.pack("<II", kind, 8 * COUNT))))
        with pytest.raises(RecordingError, match=f"numbers of type {kind}.*Save it again in MATLAB"):
            load(path)

    def test_compressed_variable_is_read(self, tmp_path: Path) -> None:
        path = tmp_path / "run.mat"
        files.mat5({"run": {"time": TIME, "angle": ANGLE}})(path)
        path.write_bytes(packed(path.read_bytes()))
        np.testing.assert_array_equal(load(path)["run/angle"], ANGLE)

    def test_cells_inside_of_cells_have_an_end(self, tmp_path: Path) -> None:
        path = tmp_path / "run.mat"
        files.mat5(cells(90))(path)
        np.testing.assert_array_equal(load(path)["angle"], ANGLE)
        files.mat5(cells(150))(path)
        with pytest.raises(RecordingError, match="more than 100 cells or structs"):
            load(path)

    def test_damaged_workspace_of_objects_is_refused(self, tmp_path: Path) -> None:
        path = tmp_path / "run.mat"
        files.unpacked(files.objects(files.two_series, "v7"))(path)
        np.testing.assert_array_equal(load(path)["angle"], ANGLE)
        content = path.read_bytes()
        right = struct.pack("<II", 9, 8 * COUNT)
        assert content.index(right) > content.index(b"FileWrapper__")
        path.write_bytes(content.replace(right, struct.pack("<II", 60000, 8 * COUNT)))
        with pytest.raises(RecordingError, match=r"numbers of type 60000.*Save it again in MATLAB"):
            load(path)


def test_ulog_whose_definitions_do_not_end_is_refused(tmp_path: Path) -> None:
    """pyulog would look for the next message for ever."""
    path = tmp_path / "run.ulg"
    path.write_bytes(b"ULog\x01\x12\x35\x01" + bytes(8) + struct.pack("<HB", 40, 0) + bytes(30))
    with pytest.raises(RecordingError, match=r"is damaged before byte 49.*Copy the file again"):
        load(path)


def test_log_of_which_no_message_can_be_read_is_refused(tmp_path: Path) -> None:
    from mcap.writer import Writer

    with (tmp_path / "run.mcap").open("wb") as file:
        writer = Writer(file)
        writer.start()
        schema = writer.register_schema("Pendulum", "protobuf", b"")
        topic = writer.register_channel("/pendulum", "protobuf", schema)
        writer.add_message(topic, 1, b"\x00", 1)
        writer.finish()
    with pytest.raises(RecordingError, match=r"/pendulum: encoding protobuf is not read: 1 messages.*PlotJuggler"):
        load(tmp_path / "run.mcap")


def test_folder_without_a_bag_is_refused(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="folder without files of a rosbag 2"):
        load(tmp_path)


def test_topics_that_would_make_too_large_a_table_are_refused_until_channels_are_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("upright.telemetry.tables.several_clocks.MOST_CELLS", 1000)
    path = tmp_path / "run.mcap"
    files.mcap_json(files.two_topics)(path)
    with pytest.raises(RecordingError, match="2 topics") as caught:
        load(path)
    assert "--map CHANNEL=/motor/voltage" in caught.value.remedy
    assert len(load(path, user=said_of(("angle=/pivot/angle",), ()))) == COUNT


PACKAGES = {
    "MF4": ("asammdf", "mf4"),
    "MCAP, JSON": ("mcap", "mcap"),
    "MCAP, ROS 2": ("rosbags", "ros"),
    "rosbag 1": ("rosbags", "ros"),
    "rosbag 2, file of SQLite": ("rosbags", "ros"),
    "ULog": ("pyulog", "ulog"),
    "dataflash": ("pymavlink", "ardupilot"),
    "MAT 7, timeseries": ("matio", "mat"),
    "MAT 7.3": ("matio", "mat"),
}


@pytest.mark.parametrize("name", PACKAGES)
def test_package_that_is_missing_is_named_with_its_extra(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    package, extra = PACKAGES[name]
    case = next(each for each in CASES if each.name == name)
    path = tmp_path / f"run{case.suffix}"
    case.write(path)
    for module in [each for each in sys.modules if each.partition(".")[0] == package]:
        monkeypatch.delitem(sys.modules, module)
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(RecordingError, match=rf"needs the package {package}.*upright\[{extra}\]"):
        load(path, WANTED)
