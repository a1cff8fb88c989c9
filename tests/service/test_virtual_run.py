"""Recordings of the virtual vehicle without a bus: as the recorder writes them, reproducible by seed, or refused."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from upright.service.control import assembly
from upright.service.observer.recording.recorder import Recorder
from upright.service.virtual.run import ClosedLoop, VirtualRunError, record
from upright.simulation.monocab.truth import PlantTruth
from upright.simulation.registry import UnknownEffectError
from upright.telemetry.recording import Recording
from upright.telemetry.storage import load as load_recording
from upright.vehicles.experiment.phases import Phase
from upright.vehicles.file import load

TRUTH = PlantTruth()
SHORT = 2.0
"""Duration of the doublet, s, for tests that do not depend on it."""


@pytest.fixture(scope="module")
def first() -> Recording:
    return record(experiment="doublet", duration=SHORT)


def same(one: Recording, other: Recording) -> bool:
    return bool(
        np.array_equal(one.timestamp_ns, other.timestamp_ns)
        and all(one[name].tobytes() == other[name].tobytes() for name in one.channels.names)
    )


def test_recording_covers_the_whole_experiment(first: Recording) -> None:
    assert first.channels == assembly.channels(load("monocab"))
    assert {Phase(int(phase)) for phase in first["phase"]} >= set(Phase) - {Phase.NONE, Phase.CENTRE, Phase.MOVE}
    exciting = np.count_nonzero(first["phase"] == Phase.EXCITE)
    assert exciting == pytest.approx(SHORT * first.rate, abs=1)
    assert np.ptp(first["excitation"][first["phase"] == Phase.EXCITE]) > 0.0
    assert all(np.isfinite(first[name][1:]).all() for name in first.channels.names)


def test_same_seed_gives_identical_bits_and_another_seed_does_not(first: Recording) -> None:
    assert same(first, record(load("monocab"), "doublet", seed=1, duration=SHORT))
    assert not same(first, record(experiment="doublet", seed=2, duration=SHORT))


def test_hidden_torque_is_balanced_by_gravity_and_gyroscopes(first: Recording) -> None:
    loaded = record(experiment="doublet", hide=["static_torque=2"], duration=SHORT)

    def carried(recording: Recording) -> float:
        """Mean torque of gravity and the gyroscopes while the vehicle is upright, N m."""
        up = np.isin(recording["phase"], (Phase.SETTLE, Phase.EXCITE))
        torque = TRUTH.gravity_stiffness * recording["roll"] + TRUTH.angular_momentum * recording["precession_rate"]
        return float(torque[up].mean())

    # A roll rate that differs by 40 mrad/s between beginning and end of these 5 s changes the mean by 13 N m.
    assert carried(loaded) - carried(first) == pytest.approx(-240.0, abs=15.0)


def test_recording_equals_that_of_the_recorder(first: Recording, tmp_path: Path) -> None:
    closed = ClosedLoop(load("monocab"))
    closed.run("doublet")
    (_, start_ns), (reason, end_ns) = closed.witness.recordings[0], closed.witness.ended[0]
    recorder = Recorder(tmp_path / "run", assembly.channels(closed.vehicle), start_ns, closed.witness.metadata[0])
    recorder.end_ns = end_ns
    recorder.add(closed.witness.frames)
    recorder.finish({"end_reason": reason, "dropped_frames": "0"}, {})
    written, returned = load_recording(recorder.path), closed.recording("here")
    assert same(written, returned)
    assert dict(written.metadata) == dict(returned.metadata)
    assert json.loads(first.metadata["experiment_definition"])["duration"] == SHORT
    assert first.metadata["end_reason"] == ""


def test_progress_rises_from_zero_to_one() -> None:
    fractions: list[float] = []
    record(experiment="hold", duration=0.5, progress=fractions.append)
    assert fractions == sorted(fractions)
    assert fractions[0] == 0.0
    assert fractions[-1] == 1.0


def test_unknown_experiment_error_suggests_the_nearest_name() -> None:
    with pytest.raises(VirtualRunError, match=r"no such experiment.*Did you mean 'multisine'") as caught:
        record(experiment="multisin")
    assert caught.value.experiment == "multisin"
    assert caught.value.recording is None
    with pytest.raises(VirtualRunError, match="Use one of: hold, step"):
        record(experiment="xyz")


@pytest.mark.parametrize("duration", [0.0, -1.0, float("nan"), float("inf")])
def test_impossible_duration_is_refused(duration: float) -> None:
    with pytest.raises(VirtualRunError, match="positive duration"):
        record(duration=duration)


def test_unknown_effect_is_refused() -> None:
    with pytest.raises(UnknownEffectError, match="coulomb_fricton"):
        record(hide=["coulomb_fricton"])


def test_failed_run_gives_its_reason_and_keeps_the_recording() -> None:
    """960 N m more than the vehicle was designed for: it cannot be raised."""
    with pytest.raises(VirtualRunError) as caught:
        record(experiment="hold", hide=["static_torque=8"])
    assert caught.value.reason
    assert "static_torque=8" in caught.value.remedy
    assert caught.value.recording is not None
    assert caught.value.recording.metadata["end_reason"].startswith(caught.value.reason)
