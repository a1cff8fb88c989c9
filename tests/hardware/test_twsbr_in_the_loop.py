"""The balancing robot on real SocketCAN: daemon and virtual vehicle as two processes, in real time."""

from __future__ import annotations

import os
import signal
from pathlib import Path

import numpy as np
import pytest
from rig import rig

from upright.telemetry.storage import load as load_recording
from upright.vehicles.experiment.phases import Phase
from upright.vehicles.file import load

pytestmark = [pytest.mark.vcan, pytest.mark.timeout(120)]

UP = (Phase.SETTLE, Phase.EXCITE, Phase.FADE)


def with_small_doublet(text: str) -> str:
    """The shipped file with a short and small doublet: this machine has delays too long for the robot at 8 V."""
    long_and_strong = "amplitude = 8.0                     # V\nwidth = 0.4                         # s, of each half\n"
    long_and_strong += "duration = 16.0"
    assert long_and_strong in text
    return text.replace(long_and_strong, "amplitude = 2.0\nwidth = 0.4\nduration = 2.0")


def test_robot_balances_through_a_recorded_doublet_and_stops_if_the_imu_is_silent(tmp_path: Path) -> None:
    """A doublet of 2 s; then the nodes of the vehicle go silent while it balances in another experiment."""
    shipped = Path(load("twsbr").path).read_text()
    with rig(tmp_path, with_small_doublet(shipped)) as made:
        code, answer = made.ask("experiment", name="doublet")
        assert code == 0, answer
        recording = load_recording(Path(answer["recording"]))
        assert set(UP) <= set(recording["phase"]), (answer, recording.truncated)
        assert recording.rate == pytest.approx(200, rel=0.01)
        assert np.degrees(np.abs(recording["tilt"][np.isin(recording["phase"], UP)]).max()) < 3.0
        assert np.abs(recording["left_wheel_angle"]).max() > 1.0, "or it has not moved"
        with made.experiment("hold") as running:
            made.until_phase("settle")
            code, refused = made.ask("experiment", name="square")
            assert code == 3
            assert "is running" in refused["text"]
            os.kill(made.vehicle.pid, signal.SIGSTOP)
            try:
                code, stopped = running.result(30)
            finally:
                os.kill(made.vehicle.pid, signal.SIGCONT)
        assert code == 4, stopped
        assert stopped["code"] == "imu_silent"
        assert made.ask("experiment", name="hold")[0] == 3
