"""Raw logs: every frame is restored, invalid lines are named, and a crash costs at most the last line."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from telemetry.candump import CandumpReader, format_frame, format_frames, parse_line
from telemetry.errors import RecordingError
from telemetry.samples import CanFrame

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


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("(1.000000000) can0", "not enough values"),
        ("1.000000000 can0 18A#00", "brackets"),
        ("(1.0000) can0 18A#00", "decimals"),
        ("(1.000000000) can0 18A##100", "CAN FD"),
        ("(1.000000000) can0 18A00", "neither"),
        ("(1.000000000) can0 18#00", "neither"),
        ("(1.000000000) can0 XYZ#00", "invalid literal"),
        ("(1.000000000) can0 18A#001", "hexadecimal|fromhex"),
        ("(1.000000000) can0 18A#001122334455667788", "9 bytes"),
        ("(1.000000000) can0 18A#R99999999999", "99999999999 bytes"),
        ("(1.000000000) can0 18A#R-1", "-1 bytes"),
    ],
)
def test_invalid_line_error_names_the_file_and_the_line(tmp_path: Path, line: str, words: str) -> None:
    log = tmp_path / "run.log"
    log.write_text(f"(0.000000000) can0 18A#00\n\n{line}\n(2.000000000) can0 18A#00\n")
    with pytest.raises(RecordingError, match=words) as caught:
        list(CandumpReader(log))
    assert (caught.value.file, caught.value.key) == (str(log), "line 3")
    assert caught.value.remedy


def test_missing_log_is_refused(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="No such file"):
        list(CandumpReader(tmp_path / "absent.log"))
