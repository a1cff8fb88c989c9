"""A raw log rebuilds the recording that was made beside it, bit for bit; and recordings in other formats."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from closed_loop import ClosedLoop
from monocab_channels import MONOCAB
from scipy.io import loadmat

from upright.service.observer.recording.recorder import Recorder
from upright.service.offline.inputs import replay
from upright.telemetry.channels import ChannelTable
from upright.telemetry.errors import RecordingError
from upright.telemetry.recording import Recording
from upright.telemetry.samples import CanFrame, Frame
from upright.telemetry.storage import load as load_file
from upright.vehicles.experiment.phases import Phase
from upright.vehicles.file import load

VEHICLE = load("monocab")


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Path stem of a recording and its raw log: the step experiment, ended soon after the vehicle is upright."""
    stem = tmp_path_factory.mktemp("run") / "step"
    loop = ClosedLoop()
    loop.loop.start_experiment("step")
    loop.until(lambda: loop.loop.run is not None and loop.loop.run.phase is Phase.EXCITE, 60.0)
    loop.loop.end_experiment("enough")
    loop.until(lambda: loop.loop.run is None, 60.0)
    (_, start_ns), (_, end_ns) = loop.witness.recordings[0], loop.witness.ended[0]
    recorder = Recorder(stem, MONOCAB, start_ns, {"kind": "monocab", "experiment": "step"}, ("can0", "can1"))
    recorder.end_ns, recorder.raw_end_ns = end_ns, end_ns + 2_000_000
    recorder.add_can(loop.raw)
    recorder.add(loop.witness.frames)
    assert recorder.complete
    recorder.finish({"end_reason": "enough"}, {})
    return stem


def alone(run: Path, folder: Path, *, lines: slice = slice(None), tail: str = "") -> Path:
    """A copy of some lines of the raw log, in another folder."""
    log = folder / "alone.log"
    log.write_text("".join(Path(f"{run}.log").read_text().splitlines(keepends=True)[lines]) + tail)
    return log


def assert_same(a: Recording, b: Recording, names: tuple[str, ...] = MONOCAB.names) -> None:
    np.testing.assert_array_equal(a.timestamp_ns, b.timestamp_ns)
    for name in names:
        np.testing.assert_array_equal(a[name], b[name], err_msg=name)


def test_raw_log_rebuilds_every_sample_and_every_estimate(run: Path) -> None:
    recorded = replay.load(Path(f"{run}.arrow"), VEHICLE)
    rebuilt = replay.load(Path(f"{run}.log"), VEHICLE)
    assert len(recorded) > 1000
    assert_same(recorded, rebuilt)
    assert rebuilt.truncated == ""
    assert rebuilt.metadata["experiment"] == "step"
    results = replay.replay(recorded, VEHICLE)
    assert results == replay.replay(rebuilt, VEHICLE)
    assert results["recursive_least_squares"]["samples"] > 10
    for method in ("recursive_output_error", "recursive_prediction_error"):
        assert results[method]["samples"] > 500
        assert results[method]["status"] == "ok"


def test_log_without_its_recording_gives_all_channels_on_the_bus(run: Path, tmp_path: Path) -> None:
    recorded = load_file(Path(f"{run}.arrow"))
    rebuilt = replay.load(alone(run, tmp_path), VEHICLE)
    assert_same(recorded, rebuilt, tuple(name for name in MONOCAB.names if name not in replay.not_on_the_bus(MONOCAB)))
    for name in replay.not_on_the_bus(MONOCAB):
        assert np.isnan(rebuilt[name]).all()
        assert name in rebuilt.truncated


@pytest.mark.parametrize("dropped", [(), (0x201, 0x202, 0x203)])
def test_log_without_its_recording_gives_the_plain_estimates_bit_for_bit(
    run: Path, tmp_path: Path, dropped: tuple[int, ...]
) -> None:
    """Neither the channels that are not on the bus nor the setpoints, whichever cycle they belong to, affect them."""
    recorded = replay.replay(replay.load(Path(f"{run}.arrow"), VEHICLE), VEHICLE)
    lines = Path(f"{run}.log").read_text().splitlines(keepends=True)
    kept = [line for line in lines if int(line.split()[2].partition("#")[0], 16) not in dropped]
    assert bool(dropped) == (len(kept) < len(lines))
    (tmp_path / "alone.log").write_text("".join(kept))
    rebuilt = replay.replay(replay.load(tmp_path / "alone.log", VEHICLE), VEHICLE)
    plain, instrumental = "recursive_least_squares", "recursive_instrumental_variables"
    assert recorded[plain]["span"] > 0.4
    assert rebuilt[plain] == recorded[plain]
    for method in ("recursive_output_error", "recursive_prediction_error"):
        assert rebuilt[method] == recorded[method]
    assert rebuilt[instrumental]["status"] == "missing_channel"
    assert "raw log does not contain it" in rebuilt[instrumental]["reason"]
    assert rebuilt[instrumental]["samples"] == 0


def test_truncated_log_gives_the_samples_before_the_cut(run: Path, tmp_path: Path) -> None:
    recorded = load_file(Path(f"{run}.arrow"))
    rebuilt = replay.load(alone(run, tmp_path, lines=slice(6000), tail="(0000001005.1234"), VEHICLE)
    assert "line 6001" in rebuilt.truncated
    rows = len(rebuilt)
    assert 100 < rows < len(recorded)
    # The setpoints for the last sample may be cut off: it then has the previous ones.
    np.testing.assert_array_equal(rebuilt["roll"], recorded["roll"][:rows])
    np.testing.assert_array_equal(
        rebuilt["precession_rate_setpoint"][:-1], recorded["precession_rate_setpoint"][: rows - 1]
    )


@pytest.mark.parametrize(
    ("kept", "words"),
    [
        (lambda can_id: can_id not in (0x18A, 0x28A, 0x38A), "18A, 28A, 38A"),
        (lambda can_id: can_id & 0x7F != 3, "trim"),
        (lambda can_id: False, "no complete IMU frame set"),
    ],
)
def test_log_of_another_vehicle_is_refused_with_a_remedy(run: Path, tmp_path: Path, kept: object, words: str) -> None:
    assert callable(kept)
    lines = Path(f"{run}.log").read_text().splitlines(keepends=True)
    log = tmp_path / "other.log"
    log.write_text("".join(line for line in lines if kept(int(line.split()[2].partition("#")[0], 16))))
    with pytest.raises(RecordingError, match=words) as caught:
        replay.load(log, VEHICLE)
    assert caught.value.file == str(log)
    assert "vehicle file" in caught.value.remedy


@pytest.mark.parametrize("suffix", [".arrow", ".parquet", ".csv"])
def test_converted_recording_gives_the_same_estimates(run: Path, tmp_path: Path, suffix: str) -> None:
    recorded = load_file(Path(f"{run}.arrow"))
    replay.convert(recorded, tmp_path / f"converted{suffix}")
    converted = load_file(tmp_path / f"converted{suffix}")
    assert replay.replay(converted, VEHICLE) == replay.replay(recorded, VEHICLE)


def test_matlab_file_keeps_values_time_units_and_metadata(run: Path, tmp_path: Path) -> None:
    recorded = load_file(Path(f"{run}.arrow"))
    replay.convert(recorded, tmp_path / "run.mat")
    content = loadmat(tmp_path / "run.mat")
    np.testing.assert_array_equal(content["roll"][:, 0], recorded["roll"])
    np.testing.assert_array_equal(content["time"][:, 0], recorded.time)
    assert content["timestamp_ns"][0, 0] == recorded.timestamp_ns[0]
    assert content["unit"]["roll_rate"][0, 0][0] == "rad/s"
    assert content["metadata"]["experiment"][0, 0][0] == "step"


def test_unsupported_format_and_missing_folder_are_refused(run: Path, tmp_path: Path) -> None:
    recorded = load_file(Path(f"{run}.arrow"))
    with pytest.raises(RecordingError, match=r"does not write \.xls"):
        replay.convert(recorded, tmp_path / "run.xls")
    for suffix in replay.CONVERTED:
        with pytest.raises(RecordingError, match="No such file"):
            replay.convert(recorded, tmp_path / "absent" / f"run{suffix}")


def test_channel_that_the_estimators_miss_is_named(run: Path) -> None:
    recorded = load_file(Path(f"{run}.arrow"))
    channels = ChannelTable(MONOCAB[:3])
    few = Recording(channels, recorded.timestamp_ns, {name: recorded[name] for name in channels.names})
    with pytest.raises(RecordingError, match="is missing") as caught:
        replay.replay(few, VEHICLE)
    assert caught.value.key == "pitch"


def test_recording_without_the_newer_channels_gives_the_same_least_squares(run: Path) -> None:
    recorded = load_file(Path(f"{run}.arrow"))
    channels = ChannelTable(each for each in MONOCAB if not each.newer)
    assert set(MONOCAB.names) - set(channels.names) == {"gyro_bias_std", "setpoint_age"}
    older = Recording(channels, recorded.timestamp_ns, {name: recorded[name] for name in channels.names})
    least_squares = "recursive_least_squares"
    assert replay.replay(older, VEHICLE)[least_squares] == replay.replay(recorded, VEHICLE)[least_squares]


def test_full_disk_ends_the_recording_and_keeps_what_was_written(tmp_path: Path) -> None:
    recorder = Recorder(tmp_path / "run", MONOCAB, 0, {}, ("can0",))
    values = (0.0,) * len(MONOCAB)
    recorder.add([Frame(i, values) for i in range(10)])
    recorder.write(recorder.take())
    recorder.add([Frame(i, values) for i in range(10, 20)])
    recorder.add_can([CanFrame(1, 0x100, b"")])

    class Full:
        def append(self, *batch: object) -> None:
            raise OSError(28, "No space left on device")

        def close(self, metadata: object) -> None: ...

    stream, recorder._stream = recorder._stream, Full()  # type: ignore[assignment]
    with pytest.raises(OSError, match="No space"):
        recorder.write(recorder.take())
    recorder._stream = stream
    recorder.add([Frame(i, values) for i in range(20, 30)])
    recorder.finish({"end_reason": "done"}, {})  # nothing is written after a gap
    assert len(load_file(tmp_path / "run.arrow")) == recorder.rows == 10
