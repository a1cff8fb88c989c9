"""Raw logs: every frame is restored, a line that is none costs no other, and a crash at most the last one."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from upright.telemetry.candump import CandumpReader, format_frame, format_frames, parse_line, parse_time
from upright.telemetry.errors import RecordingError
from upright.telemetry.samples import CanFrame

stamps = st.integers(0, 9_999_999_999_999_999_999)
payloads = st.binary(max_size=8)
standard = st.builds(CanFrame, stamps, st.integers(0, 0x7FF), payloads)
extended = st.builds(CanFrame, stamps, st.integers(0, 0x1FFFFFFF), payloads, extended=st.just(True))
remote = st.builds(
    CanFrame, stamps, st.integers(0, 0x7FF), st.integers(0, 8).map(bytes), remote=st.just(True), extended=st.booleans()
)
errors = st.builds(CanFrame, stamps, st.integers(0, 0x1FFFFFFF), payloads, error=st.just(True))


@given(st.one_of(standard, extended, remote, errors))
def test_every_frame_survives_formatting_and_parsing(frame: CanFrame) -> None:
    assert parse_line(format_frame(frame, "can0"), {}) == frame


def test_lines_have_the_format_of_candump() -> None:
    frame = CanFrame(1_730_301_035_277_560_123, 0x18A, bytes.fromhex("0011FF"))
    assert format_frame(frame, "can0") == "(1730301035.277560123) can0 18A#0011FF"
    assert parse_line("(1730301035.277560) vcan0 18A#0011FF", {}).timestamp_ns == 1_730_301_035_277_560_000
    error = CanFrame(1, 0x004, bytes(8), error=True)
    assert format_frame(error, "can1") == "(0000000000.000000001) can1 20000004#0000000000000000"


def test_buses_are_numbered_in_order_of_appearance(tmp_path: Path) -> None:
    log = tmp_path / "run.log"
    log.write_text(format_frames([CanFrame(1, 1, b""), CanFrame(2, 2, b"", bus=1), CanFrame(3, 3, b"")], ("a", "b")))
    reader = CandumpReader(log)
    assert [frame.bus for frame in reader] == [0, 1, 0]
    assert reader.buses == {"a": 0, "b": 1}


@pytest.mark.parametrize(
    "tail", ["(0000000002.0000", "(0000000002.000000000) can0 18A#00112", "(0000000002.000000000) can0 18A#0011"]
)
def test_last_line_without_an_end_is_left_out_and_reported(tmp_path: Path, tail: str) -> None:
    log = tmp_path / "run.log"
    log.write_text("(0000000001.000000000) can0 18A#0011\n" + tail)
    reader = CandumpReader(log)
    assert [frame.timestamp_ns for frame in reader] == [1_000_000_000]
    assert "line 2" in reader.truncated


WRONG = [
    ("(1.000000000) can0", "not a CAN frame"),
    ("18A#00", "not a CAN frame"),
    ("(1.000000000) can0 18A00", "not a CAN frame"),
    ("(1.000000000) can0 XYZ#00", "not a CAN frame"),
    ("(a while ago) can0 18A#00", "not a CAN frame"),
    ("(a while ago)  can0  18A   [1]  00", "no time"),
    ("(1.000000000) can0 8FF#00", "8FF is not a CAN id"),
    ("(1.000000000) can0 FFFFFFFF#00", "FFFFFFFF is not a CAN id"),
    ("(1.000000000) can0 18A#001", "hexadecimal|fromhex"),
    ("(1.000000000) can0 18A#001122334455667788", "9 bytes"),
    ("(1.000000000) can0 18A#R99999999999", "remote frame of 99999999999 bytes"),
    ("(1.000000000) can0 18A#R-1", "remote frame of -1 bytes"),
    (" (1.000000)  can0  18A   [4]  00 11", "2 bytes of 4"),
]


@pytest.mark.parametrize(("line", "words"), WRONG)
def test_line_that_is_no_frame_is_left_out_and_said(tmp_path: Path, line: str, words: str) -> None:
    log = tmp_path / "run.log"
    log.write_text(f"(0.000000000) can0 18A#00\n\n{line}\n(2.000000000) can0 18A#00\n")
    reader = CandumpReader(log)
    assert [frame.timestamp_ns for frame in reader] == [0, 2_000_000_000]
    assert re.search(rf"1 line .*left out \(line 3: .*({words})", reader.truncated), reader.truncated


@pytest.mark.parametrize(("line", "words"), WRONG)
def test_log_without_a_frame_is_refused_with_the_line(tmp_path: Path, line: str, words: str) -> None:
    log = tmp_path / "run.log"
    log.write_text(f"# a comment\n{line}\n{line}\n")
    with pytest.raises(RecordingError, match=words) as caught:
        list(CandumpReader(log))
    assert (caught.value.file, caught.value.key) == (str(log), "line 2")
    assert caught.value.remedy


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("1.5", 1_500_000_000),
        ("0001730301035.27756", 1_730_301_035_277_560_000),
        ("1730301035.2775601234", 1_730_301_035_277_560_123),
        ("12", 12_000_000_000),
        ("6.3e-05", 63_000),
        ("2024-10-30 15:10:35.277560", 1_730_301_035_277_560_000),
        ("2024-10-30T16:10:35.277560+01:00", 1_730_301_035_277_560_000),
    ],
)
def test_times_are_read_in_every_spelling(text: str, expected: int) -> None:
    assert parse_time(text) == expected


def test_can_fd_frame_keeps_its_data() -> None:
    frame = parse_line(f"(1.0) can0 7A0##3{bytes(range(12)).hex()}", {})
    assert (frame.can_id, frame.data) == (0x7A0, bytes(range(12)))


def test_missing_log_is_refused(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="No such file"):
        list(CandumpReader(tmp_path / "absent.log"))


def test_line_without_an_end_is_no_frame_and_the_next_one_is_read(tmp_path: Path) -> None:
    log = tmp_path / "run.log"
    log.write_text("(1.0) can0 123#00\n" + 50_005 * "0" + "\n(1.1) can0 124#00\n" + 50_000 * "0")
    reader = CandumpReader(log)
    assert [frame.can_id for frame in reader] == [0x123, 0x124]
    assert "2 lines are no CAN frames" in reader.truncated
