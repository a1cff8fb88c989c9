"""What the model lacks while a vehicle moves: from the cycles of recordings whose hidden effect is known."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import golden
import numpy as np
import pytest
import virtual_records

from upright.service.mqtt.topics import Gap
from upright.service.observer.live.live_prediction import LivePrediction
from upright.telemetry.recording import Recording
from upright.vehicles import registry
from upright.vehicles.file import load

FRICTION = 400.0
"""N m s/rad, of the MONOCAB that hides viscous friction (simulation.monocab.hidden)."""


def gaps(kind: str, recording: Recording, known: Mapping[str, float] | None = None) -> list[dict[str, Any]]:
    """The gap of each segment, without the first second of free motion."""
    vehicle, channels = load(kind), registry.channels_of(kind)
    given = vehicle.parameters
    prediction = LivePrediction(
        kind, {**given.values, **(known or {})}, given.deviations, vehicle.support, channels, vehicle.control.rate
    )
    return [segment["gap"] for segment in prediction.update(recording.frames(channels))][2:]


def force(found: list[dict[str, Any]], joint: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Times, values and standard deviations of the force that is missing at `joint`."""
    times = [each["t0"] + each["dt"] * np.arange(len(each["missing_force"][joint]["values"])) for each in found]
    values, std = ([each["missing_force"][joint][key] for each in found] for key in ("values", "std"))
    return np.concatenate(times), np.concatenate(values), np.concatenate(std)


@pytest.fixture(scope="module")
def recording() -> Recording:
    return virtual_records.multisine("viscous_friction")


@pytest.fixture(scope="module")
def found(recording: Recording) -> list[dict[str, Any]]:
    """The gap of the true model without the friction."""
    return gaps("monocab", recording, virtual_records.TRUTH)


@pytest.fixture(scope="module")
def clean() -> list[dict[str, Any]]:
    return gaps("monocab", virtual_records.multisine(), virtual_records.TRUTH)


def test_missing_torque_is_that_of_the_hidden_friction(
    found: list[dict[str, Any]], clean: list[dict[str, Any]], recording: Recording
) -> None:
    times, torque, std = force(found, "roll")
    rate = np.interp(times, recording.timestamp_ns * 1e-9, recording["roll_rate"])
    # The same excitation and noise: what the true model lacks, too, cancels.
    by_friction = torque - force(clean, "roll")[1]
    assert np.polyfit(rate, by_friction, 1)[0] == pytest.approx(-FRICTION, rel=0.1)
    assert np.mean(np.abs(by_friction + FRICTION * rate) < 2.0 * std) > 0.9
    assert np.std(torque) > 2.0 * np.mean(std)  # the band does not hide it


def test_without_a_hidden_effect_the_band_contains_zero(clean: list[dict[str, Any]]) -> None:
    _, torque, std = force(clean, "roll")
    assert np.mean(np.abs(torque) < 2.0 * std) > 0.9


def test_error_is_over_the_floor_if_an_effect_is_missing(
    found: list[dict[str, Any]], clean: list[dict[str, Any]]
) -> None:
    def over(gap: dict[str, Any]) -> float:
        return float(np.sqrt(np.mean(np.square(gap["error"]["roll_rate"]))) / gap["floor"]["roll_rate"])

    usual, missing = (np.median([over(gap) for gap in each]) for each in (clean, found))
    assert usual == pytest.approx(1.0, abs=0.3)
    assert missing > 1.4 * usual


def test_only_channels_whose_noise_the_data_show_are_tested(found: list[dict[str, Any]]) -> None:
    """The roll is a filter's output, with a noise that is only stated."""
    assert all(each["error"].keys() == each["floor"].keys() == {"roll_rate"} for each in found)


def test_it_has_the_form_that_is_published(found: list[dict[str, Any]]) -> None:
    for each in found:
        Gap.model_validate(each, strict=True)


def test_torque_of_the_robot_is_missing_at_the_joint_where_it_acts() -> None:
    """Three joints of two degrees of freedom: a torque at the wheels is a combination of the other two."""
    recording = golden.recorded("twsbr", "square", hide=("disturbance", "static_torque"), seed=83, duration=16.0)
    found = gaps("twsbr", recording)
    means = {joint: float(np.mean(force(found, joint)[1])) for joint in ("tilt", "travel", "wheels")}
    assert means["tilt"] == pytest.approx(0.01, rel=0.3)
    assert abs(means["travel"]) < 0.3 * abs(means["tilt"])
