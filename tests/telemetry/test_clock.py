"""Time stamps that jitter: the channels show whether the samples were taken by a clock or at the stamped times."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from benchmarks.others_recordings import SENSORS, OthersVehicle
from upright.service.cli.inputs import load_recording
from upright.telemetry.channels import Channel, ChannelTable
from upright.telemetry.clock import jitter, with_regular_times
from upright.telemetry.recording import Recording

Array = NDArray[np.float64]

PERIOD, ROWS, JITTER, NOISE = 5e-3, 6000, 5e-4, 2e-5


def motion(time: Array) -> Array:
    return 0.02 * np.sin(2.0 * np.pi * 1.3 * time) + 0.01 * np.sin(2.0 * np.pi * 3.9 * time)


def record(stamps: Array, *, taken: Array, seed: int = 1) -> Recording:
    """An angle that was sampled at the times `taken`, s, and stamped with `stamps`, s."""
    noise = NOISE * np.random.default_rng(seed).standard_normal(len(taken))
    return Recording(
        channels=ChannelTable((Channel("angle", "rad", "of a pendulum"),)),
        timestamp_ns=np.round(1e9 * (stamps - stamps[0])).astype(np.int64),
        values={"angle": motion(taken) + noise},
    )


@pytest.fixture
def clock() -> Array:
    return PERIOD * np.arange(ROWS)


@pytest.fixture
def jittering(clock: Array) -> Array:
    return clock + JITTER * np.random.default_rng(2).standard_normal(ROWS)


@pytest.mark.parametrize("missing", [0.0, 0.02])
def test_stamps_of_samples_taken_by_a_clock_are_set_to_that_clock(
    clock: Array, jittering: Array, missing: float
) -> None:
    kept = np.random.default_rng(3).uniform(size=ROWS) >= missing
    found = with_regular_times(record(jittering[kept], taken=clock[kept]))
    off = found.time - clock[kept]
    # Errors slower than the window remain: the clock's own beginning, and the mean jitter of a window.
    assert np.std(off - np.mean(off)) < 0.2 * JITTER
    assert "0.49 ms RMS" in found.truncated or "0.5 ms RMS" in found.truncated
    np.testing.assert_allclose(found.stamped, jittering[kept] - jittering[kept][0], atol=1e-8)
    part = found.between(1.0, 2.0)
    assert len(part.stamped) == len(part)


@pytest.mark.parametrize("missing", [0.0, 0.02])
def test_stamps_of_samples_taken_at_the_stamped_times_are_unchanged(
    clock: Array, jittering: Array, missing: float
) -> None:
    kept = np.random.default_rng(3).uniform(size=ROWS) >= missing
    whole = record(jittering[kept], taken=jittering[kept])
    found = jitter(whole)
    assert found is not None
    assert abs(found.share) < 4.0 * found.share_error + 0.02
    assert with_regular_times(whole) is whole


def test_share_is_one_half_if_samples_half_follow_their_stamps(clock: Array, jittering: Array) -> None:
    found = jitter(record(jittering, taken=0.5 * (clock + jittering)))
    assert found is not None
    assert found.share == pytest.approx(0.5, abs=4.0 * found.share_error + 0.01)


def test_drifting_clock_is_not_jitter(clock: Array) -> None:
    drifting = clock * (1.0 + 1e-4) + 1e-3 * np.sin(2.0 * np.pi * clock / 10.0)
    assert jitter(record(drifting, taken=drifting)) is None


def test_noise_alone_leaves_the_stamps_unchanged(clock: Array, jittering: Array) -> None:
    whole = record(jittering, taken=clock)
    still = replace(whole, values={"angle": np.random.default_rng(4).standard_normal(ROWS)})
    assert with_regular_times(still) is still


@pytest.mark.parametrize("by_clock", [True, False])
def test_held_commands_do_not_affect_the_estimate(clock: Array, jittering: Array, by_clock: bool) -> None:
    """A command that steps once, a square wave, and a constant one, in addition to the measured channel."""
    whole = record(jittering, taken=clock if by_clock else jittering)
    held = {"once": (clock > 9.0) * 1.0, "square": np.sign(np.sin(clock)), "rests": np.zeros(ROWS)}
    channels = ChannelTable((*whole.channels, *(Channel(name, "V", "held") for name in held)))
    alone, beside = jitter(whole), jitter(replace(whole, channels=channels, values={**whole.values, **held}))
    assert alone is not None
    assert beside is not None
    assert beside.share == pytest.approx(alone.share, abs=alone.share_error)


def test_table_with_jittering_stamps_is_loaded_with_regular_times(tmp_path: Path) -> None:
    """Except `as_stamped`, for a replay, which repeats bit for bit what the vehicle computed with its stamps."""
    path = OthersVehicle(sensors=SENSORS["jitter"], seed=5).write(tmp_path / "logged.csv", 10.0)
    found, stamped = load_recording(path, "monocab"), load_recording(path, "monocab", as_stamped=True)
    assert np.std(np.diff(found.time)) < 0.1 * 5e-4
    assert "taken as sampled by the clock" in found.truncated
    assert np.std(np.diff(stamped.time)) > 5e-4
    assert "clock" not in stamped.truncated
