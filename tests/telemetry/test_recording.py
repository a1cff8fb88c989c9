"""Recordings in files: no bit is lost, a truncated file is read as far as possible, an invalid one gives an error."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet
import pytest
from monocab_channels import MONOCAB

from upright.telemetry.arrow_file import ArrowStreamWriter
from upright.telemetry.channels import ChannelTable
from upright.telemetry.errors import RecordingError
from upright.telemetry.recording import Recording
from upright.telemetry.storage import load, save

START_NS = 1_730_301_035_277_560_123
TWO = ChannelTable(MONOCAB[:2])


def make(rows: int = 40, channels: ChannelTable = MONOCAB) -> Recording:
    """Noise at 250 Hz with a jitter below 100 ns, and one unknown value."""
    random = np.random.default_rng(7)
    values = {name: 0.1 * random.standard_normal(rows) for name in channels.names}
    values["roll_rate"][3] = np.nan
    stamps = START_NS + 4_000_000 * np.arange(rows) + random.integers(-99, 99, rows)
    return Recording(channels, stamps, values, {"vehicle": "monocab", "note": "grüße"})


def assert_same_values(a: Recording, b: Recording) -> None:
    assert a.channels.names == b.channels.names
    for name in a.channels.names:
        np.testing.assert_array_equal(a[name], b[name], strict=True)


@pytest.mark.parametrize("suffix", [".arrow", ".parquet"])
def test_arrow_and_parquet_keep_every_bit(tmp_path: Path, suffix: str) -> None:
    original = make()
    save(original, tmp_path / f"run{suffix}")
    read = load(tmp_path / f"run{suffix}")
    assert_same_values(original, read)
    np.testing.assert_array_equal(original.timestamp_ns, read.timestamp_ns, strict=True)
    assert (read.metadata, read.channels, read.truncated) == (original.metadata, MONOCAB, "")


def test_csv_keeps_every_value_and_nanosecond_since_the_start(tmp_path: Path) -> None:
    original = make()
    save(original, tmp_path / "run.csv")
    read = load(tmp_path / "run.csv")
    assert_same_values(original, read)
    np.testing.assert_array_equal(original.timestamp_ns - original.timestamp_ns[0], read.timestamp_ns)


def test_frames_contain_the_samples_in_the_requested_channel_order() -> None:
    recording = make()
    swapped = ChannelTable((MONOCAB[1], MONOCAB[0]))
    frames = list(recording.frames(swapped))
    assert [frame.timestamp_ns for frame in frames] == recording.timestamp_ns.tolist()
    assert frames[5].values == (recording["roll_rate"][5], recording["roll"][5])
    assert recording.rate == pytest.approx(250.0, rel=1e-4)  # jitter of 100 ns in 4 ms
    assert recording.duration == pytest.approx(39 * 0.004, abs=1e-6)


def stream(path: Path, batches: int) -> tuple[Recording, list[int]]:
    """A stream of batches of ten samples, as the recorder writes it, and the file's size after each."""
    recording = make(10 * batches, TWO)
    table = np.stack([recording.values[name] for name in TWO.names], axis=1)
    writer = ArrowStreamWriter(path, TWO, {"vehicle": "monocab"})
    sizes = []
    for first in range(0, 10 * batches, 10):
        writer.append(recording.timestamp_ns[first : first + 10], table[first : first + 10])
        sizes.append(path.stat().st_size)
    writer.close({"end_reason": "done"})
    return recording, sizes


def test_unclosed_stream_is_read_to_its_last_batch(tmp_path: Path) -> None:
    original, sizes = stream(tmp_path / "run.arrow", 3)
    (tmp_path / "run.arrow").write_bytes((tmp_path / "run.arrow").read_bytes()[: sizes[-1]])
    read = load(tmp_path / "run.arrow")
    assert_same_values(original, read)
    assert "not closed" in read.truncated


def test_truncated_stream_gives_the_complete_batches_before_the_cut(tmp_path: Path) -> None:
    path, cut = tmp_path / "run.arrow", tmp_path / "cut.arrow"
    original, sizes = stream(path, 3)
    content = path.read_bytes()
    for length in range(0, len(content), 13):
        cut.write_bytes(content[:length])
        whole = sum(size <= length for size in sizes)
        if whole == 0:
            with pytest.raises(RecordingError):
                load(cut)
            continue
        read = load(cut)
        assert len(read) == 10 * whole
        np.testing.assert_array_equal(read["roll"], original["roll"][: 10 * whole])
        assert read.truncated


def test_metadata_written_on_close_are_read_with_the_rest(tmp_path: Path) -> None:
    stream(tmp_path / "run.arrow", 1)
    read = load(tmp_path / "run.arrow")
    assert read.metadata == {"vehicle": "monocab", "end_reason": "done"}
    assert read.truncated == ""


def test_stream_never_overwrites_a_file(tmp_path: Path) -> None:
    stream(tmp_path / "run.arrow", 1)
    with pytest.raises(FileExistsError):
        ArrowStreamWriter(tmp_path / "run.arrow", TWO, {})
    assert len(load(tmp_path / "run.arrow")) == 10


def csv(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "data.csv"
    path.write_text(text)
    return path


def test_csv_of_other_origin_is_read(tmp_path: Path) -> None:
    read = load(csv(tmp_path, "\ufeffroll, time ,my sensor\n0.01,0.5,7\n\n0.02,0.504,\n"))
    assert read.timestamp_ns.tolist() == [500_000_000, 504_000_000]
    assert read["roll"].tolist() == [0.01, 0.02]
    assert read.channels[0] == MONOCAB[0]
    assert (read["my sensor"][0], np.isnan(read["my sensor"][1])) == (7.0, True)


def test_truncated_last_line_of_a_csv_is_left_out_and_reported(tmp_path: Path) -> None:
    read = load(csv(tmp_path, "time,roll\n0.0,0.01\n0.004,0.02\n0.0"))
    assert len(read) == 2
    assert "line 4" in read.truncated


@pytest.mark.parametrize(
    ("text", "key", "words"),
    [
        ("roll,roll_rate\n1,2\n", "time", "header"),
        ("", "", "no rows"),
        ("time,roll\n0,0.1,0.2\n1,0.1,0.2\n3,0.1,0.2\n", "line 2", "2 headings for 3 columns"),
        ("time,roll\n,0.1\n-,0.1\n", "time", "--map time="),
        ("time,roll\n0.0,3.9\n0.1,-4.0\n", "roll", "cannot be rad"),
        ("time,roll\n", "", "no rows"),
        ("time\n0.0\n0.1\n", "", "no channels"),
        ("time,roll\n0.0,0.1\n1e300,0.1\n", "time", "century"),
    ],
)
def test_invalid_csv_error_names_the_place_and_a_remedy(tmp_path: Path, text: str, key: str, words: str) -> None:
    path = csv(tmp_path, text)
    with pytest.raises(RecordingError, match=words) as caught:
        load(path)
    assert (caught.value.file, caught.value.key) == (str(path), key)
    assert caught.value.remedy


def test_files_that_are_not_recordings_are_refused(tmp_path: Path) -> None:
    for name, words in [
        ("absent.arrow", "No such file"),
        ("absent.csv", "No such file"),
        ("run.log", "--vehicle"),
        ("run.xlsx", "not stored as .xlsx"),
        ("run", "without a suffix"),
    ]:
        with pytest.raises(RecordingError, match=words):
            load(tmp_path / name)
    for suffix in (".arrow", ".parquet", ".csv"):
        path = tmp_path / f"noise{suffix}"
        path.write_bytes(np.random.default_rng(1).bytes(4096))
        with pytest.raises(RecordingError) as caught:
            load(path)
        assert caught.value.remedy


def test_truncated_parquet_file_is_refused(tmp_path: Path) -> None:
    save(make(), tmp_path / "run.parquet")
    content = (tmp_path / "run.parquet").read_bytes()
    (tmp_path / "run.parquet").write_bytes(content[: len(content) // 2])
    with pytest.raises(RecordingError, match="not a complete Parquet file"):
        load(tmp_path / "run.parquet")


def test_parquet_of_other_origin_is_read_and_invalid_columns_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "other.parquet"
    pa.parquet.write_table(pa.table({"time": [0.0, 0.004], "roll": pa.array([0.1, None], pa.float32())}), path)
    read = load(path)
    assert read.timestamp_ns.tolist() == [0, 4_000_000]
    assert np.isnan(read["roll"][1])
    pa.parquet.write_table(pa.table({"time": [0.0], "roll": ["steep"]}), path)
    with pytest.raises(RecordingError, match="no channels"):
        load(path)
    pa.parquet.write_table(pa.table({"roll": [0.0]}), path)
    with pytest.raises(RecordingError, match="--map time=") as caught:
        load(path)
    assert caught.value.key == "time"


def test_table_with_a_name_twice_or_times_beyond_all_sense_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "other.parquet"
    for columns, names, words in (
        ([[0, 1], [0.1, 0.2], [0.3, 0.4]], ["timestamp_ns", "roll", "roll"], "twice"),
        ([[-(2**63), 2**63 - 1], [0.1, 0.2]], ["timestamp_ns", "roll"], "century"),  # their difference overflows
        ([[float("nan"), float("nan")], [0.1, 0.2]], ["time", "roll"], "not numbers"),
    ):
        pa.parquet.write_table(pa.Table.from_arrays([pa.array(column) for column in columns], names), path)
        with pytest.raises(RecordingError, match=words) as caught:
            load(path)
        assert caught.value.remedy


def test_missing_channel_error_names_the_key_and_the_closest_channel() -> None:
    recording = make()
    with pytest.raises(RecordingError, match="'precession_rate'") as caught:
        recording["precession_rat"]
    assert caught.value.key == "precession_rat"
    with pytest.raises(RecordingError, match="first in row 4"):
        recording.require("roll", "roll_rate", finite=True)
    recording.require("roll", finite=True)
    with pytest.raises(RecordingError):
        list(make(channels=TWO).frames(MONOCAB))


def test_columns_of_different_length_are_refused() -> None:
    with pytest.raises(RecordingError, match="3 values for 2 instants"):
        Recording(ChannelTable(MONOCAB[:1]), np.array([1, 2]), {"roll": np.zeros(3)})


def test_part_of_a_recording_keeps_its_samples_and_an_empty_part_is_refused() -> None:
    recording = make(40)
    span = float(recording.time[-1] - recording.time[0])
    part = recording.between(0.25 * span, 0.5 * span)
    first = int(np.flatnonzero(recording.timestamp_ns == part.timestamp_ns[0])[0])
    assert 0 < first < 20
    for name in recording.channels.names:
        assert np.array_equal(part[name], recording[name][first : first + len(part)], equal_nan=True)
    assert len(recording.between()) == 40
    with pytest.raises(RecordingError, match="has no rows from"):
        recording.between(2.0 * span)
