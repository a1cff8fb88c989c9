"""A vehicle that falls while it is recorded: the fall is detected, reported, and excluded from fits.

The vehicles are the virtual robot and the virtual MONOCAB, with a torque step larger than they can withstand.
"""

from __future__ import annotations

import functools
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from upright.estimators.data.segments import BEFORE_A_FALL, falls_at, segments
from upright.estimators.recursive.frame_chunks import FrameChunks
from upright.models import library
from upright.models.natural_time import USUAL, natural_time
from upright.service.cli import app
from upright.service.control import assembly
from upright.service.virtual.run import VirtualRunError, record
from upright.telemetry.recording import Recording
from upright.telemetry.storage import save
from upright.vehicles.experiment.phases import Phase
from upright.vehicles.file import load

MODEL = {"twsbr": "twsbr", "monocab": "monocab_roll"}
PUSH = {"twsbr": 90.0, "monocab": 60.0}
"""Level of the torque step: a multiple of the virtual vehicle's own `torque_step`."""
PUSHED = 18.0
"""s after the start of the virtual vehicle at which the torque step sets in."""


@functools.cache
def fallen(name: str) -> Recording:
    with pytest.raises(VirtualRunError, match="beyond the limit") as caught:
        record(name, "hold", hide=[f"torque_step={PUSH[name]:g}@{PUSHED:g}"], seed=9)
    assert caught.value.recording is not None
    return caught.value.recording


@pytest.mark.parametrize("name", list(MODEL))
def test_fall_and_the_time_before_it_are_excluded_from_the_segments(name: str) -> None:
    recording, vehicle, model = fallen(name), load(name), library.get(MODEL[name])
    begin = falls_at(model, recording, vehicle.support)
    ended = float(recording.time[recording["phase"] != Phase.NONE][-1])
    assert begin is not None
    assert ended - 1.0 < begin < ended
    coordinate = np.abs(recording[model.joints[0].coordinate])
    used = segments(model, [recording], support=vehicle.support)
    usable = begin - BEFORE_A_FALL * (natural_time(model) or USUAL)
    assert [each.time[-1] < usable + 0.5 * vehicle.period for each in used] == [True] * len(used)
    assert np.max(coordinate[(recording.time > 0.5 * begin) & (recording.time < begin)]) < 0.2 * vehicle.support
    assert used[-1].time[-1] == pytest.approx(usable, abs=2.0 * vehicle.period)
    assert begin < float(recording.time[coordinate > 0.5 * vehicle.support][-1])


@pytest.mark.parametrize("name", list(MODEL))
def test_live_estimation_uses_no_samples_after_the_end_of_the_run(name: str) -> None:
    recording, vehicle, model = fallen(name), load(name), library.get(MODEL[name])
    channels = assembly.channels(vehicle)
    cutter = FrameChunks(model, channels, support=vehicle.support, rows=25)
    chunks = [chunk for frame in recording.frames(channels) if (chunk := cutter.update(frame))]
    last = max(float(chunk.segment.time[chunk.last]) for chunk in chunks)
    ended = float(recording.time[recording["phase"] != Phase.NONE][-1])
    assert ended - 1.0 < last < ended


@pytest.mark.parametrize("name", list(MODEL))
def test_run_that_ends_in_order_is_not_a_fall(name: str) -> None:
    recording, vehicle, model = record(name, "hold", seed=9, duration=8.0), load(name), library.get(MODEL[name])
    assert falls_at(model, recording, vehicle.support) is None
    (used,) = segments(model, [recording], support=vehicle.support)
    unknown = {**recording.values, "phase": np.full(len(recording.time), math.nan)}
    (without_phase,) = segments(model, [replace(recording, values=unknown)], support=vehicle.support)
    assert np.array_equal(used.time, without_phase.time)


def test_command_line_reports_time_and_cause_of_the_fall(tmp_path: Path) -> None:
    path = tmp_path / "fallen.arrow"
    save(fallen("twsbr"), path)
    done = CliRunner().invoke(app, ["identify", str(path), "--vehicle", "twsbr", "--method", "prediction_error"])
    output = " ".join(done.stderr.split())
    assert "the vehicle falls 1" in output
    assert "tilt while balancing" in output
    assert "No fit uses the rest" in output
