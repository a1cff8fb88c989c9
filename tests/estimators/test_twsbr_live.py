"""The balancing robot's live estimator on recordings of the virtual one, whose truth is known."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from estimators.contract import Estimate, Status
from estimators.identify.run import identify
from estimators.methods.prediction_error import prediction_error
from estimators.recursive.prediction_error import RecursivePredictionError
from models.expressions import number
from service.observer.online_estimators import RECURSION, STARTING, EstimatorBank, online_estimators
from service.offline.replay import replay
from service.virtual.run import record
from simulation.twsbr.truth import TwsbrTruth
from telemetry.recording import Recording
from telemetry.samples import Frame
from vehicles.file import load
from vehicles.registry import nominal_model
from vehicles.twsbr.channels import CHANNELS as TWSBR
from vehicles.twsbr.model import COUNT, IDENTIFIABLE_NEAR_UPRIGHT

VEHICLE = load("twsbr")
GIVEN = {"parameters": VEHICLE.parameters.values, "deviations": VEHICLE.parameters.deviations}
MODEL = nominal_model("twsbr")
SOUGHT = [each.name for each in MODEL.parameters if each.estimated]
TRUTH = {**TwsbrTruth().table_1, "voltage_offset": 1e-3}  # s, in the drive: it acts on a command in its next cycle
LATENCY = 1.5
"""s of free motion after which values are told."""
SEEDS = [1, 2, 3, 4]


@cache
def run(name: str = "square", seed: int = 1) -> Recording:
    return record("twsbr", name, seed=seed)


def made() -> RecursivePredictionError:
    return RecursivePredictionError(MODEL, **GIVEN, support=VEHICLE.support, channels=TWSBR)


@cache
def course(seed: int, name: str = "square") -> list[Estimate]:
    """What it says every second, the end included."""
    return looks(run(name, seed))


def looks(recording: Recording) -> list[Estimate]:
    estimator, frames = made(), list(recording.frames(TWSBR))
    found = []
    for place, frame in enumerate(frames, 1):
        estimator.update(frame)
        if place % 200 == 0 or place == len(frames):
            found.append(estimator.result())
    return found


def deviations_off(estimate: Estimate) -> dict[str, float]:
    """Standard deviations that each value that is told is off the truth."""
    return {
        name: abs(each.value - TRUTH[name]) / each.std
        for name, each in estimate.parameters.items()
        if each.value is not None and each.std is not None
    }


def bank() -> EstimatorBank:
    return online_estimators("twsbr", GIVEN["parameters"], GIVEN["deviations"], VEHICLE.support)


# --- what it says, and when


@pytest.mark.parametrize("seed", SEEDS)
def test_after_a_square_wave_all_that_is_sought_is_told_and_true(seed: int) -> None:
    last = course(seed)[-1]
    assert (last.status, last.reason) == (Status.OK, "")
    off = deviations_off(last)
    assert list(off) == SOUGHT
    assert max(off.values()) < 4.0


@pytest.mark.parametrize("seed", SEEDS)
def test_on_the_way_it_is_never_surer_than_it_can_be(seed: int) -> None:
    told = [(each.span, deviations_off(each)) for each in course(seed)]
    assert all(not off for span, off in told if span < 0.4)
    later = [bool(off) for span, off in told if span > LATENCY]
    assert sum(later) >= 0.9 * len(later)
    assert max(value for _, off in told for value in off.values()) < 4.0


@pytest.mark.parametrize("seed", SEEDS)
def test_its_deviations_are_those_of_the_fit_of_the_whole_recording(seed: int) -> None:
    """What is told in products only stays as open as it is, although the equations come in one after the other."""
    live, wide = course(seed)[-1], 0.25 * TRUTH["armature_resistance"]
    batch = prediction_error(MODEL.change(GIVEN["parameters"], deviations=GIVEN["deviations"]), [run("square", seed)])
    for name in SOUGHT:
        here, there = live.parameters[name].std, batch.parameters[name].std
        assert here is not None, name
        assert there is not None, name
        assert 0.6 < here / there < 1.6, name
    assert live.parameters["armature_resistance"].std > wide


@pytest.mark.parametrize("name", ["inertia of travel", "inertia of tilt", "inertia that both share"])
@pytest.mark.parametrize("seed", SEEDS)
def test_products_are_true_where_their_factors_are_open(seed: int, name: str) -> None:
    """To 5 %; with the vehicle file's numbers they are off by 15, 16 and 19 %."""
    found = number(
        IDENTIFIABLE_NEAR_UPRIGHT[name], {**MODEL.values, **GIVEN["parameters"], **course(seed)[-1].values}, name
    )
    assert found == pytest.approx(number(IDENTIFIABLE_NEAR_UPRIGHT[name], {**MODEL.values, **TRUTH}, name), rel=0.05)


@pytest.mark.parametrize("name", ["sine", "doublet", "sine_stream"])
def test_other_experiments_tell_it_too(name: str) -> None:
    looked = course(1, name)
    assert looked[-1].status is Status.OK
    assert max(value for each in looked for value in deviations_off(each).values()) < 4.0


def test_wheels_that_do_not_read_alike_are_told_as_well() -> None:
    """The virtual robot's read alike to the last bit. Here one encoder has half a count of noise more."""
    whole = run()
    noise = COUNT * np.random.default_rng(3).uniform(-0.5, 0.5, len(whole))
    values = {**whole.values, "right_wheel_angle": whole["right_wheel_angle"] + noise}
    last = looks(replace(whole, values=values))[-1]
    assert last.status is Status.OK
    assert max(deviations_off(last).values()) < 4.0


# --- what it cannot say


def test_a_robot_that_only_stands_gives_no_number_that_is_wrong() -> None:
    looked = course(1, "hold")
    assert any(each.status is not Status.OK for each in looked)
    for each in looked:
        assert all(value < 4.0 for value in deviations_off(each).values())
        assert all(each.reason or value.identifiable for value in each.parameters.values())


def test_a_robot_that_lies_on_its_bumper_tells_nothing_and_says_so() -> None:
    whole = run()
    lying = replace(whole, values={**whole.values, "tilt": np.full(len(whole), np.radians(12.4))})
    last = looks(lying)[-1]
    assert last.status is Status.TOO_FEW_SAMPLES
    assert "hardly left its supports" in last.reason
    assert all(each.value is None and each.std is None for each in last.parameters.values())


def test_an_encoder_that_is_silent_for_a_second_is_a_gap() -> None:
    whole = run()
    silent = (whole.time > 15.0) & (whole.time < 16.0)
    values = {**whole.values, "left_wheel_angle": np.where(silent, np.nan, whole["left_wheel_angle"])}
    last = looks(replace(whole, values=values))[-1]
    assert last.status is Status.OK
    assert last.samples < course(1)[-1].samples - 200
    assert max(deviations_off(last).values()) < 4.0


def test_a_blow_is_left_out_and_told() -> None:
    whole = run()
    blow = np.where(np.abs(whole.time - 15.0) < 0.02, 3.0, 0.0)
    last = looks(replace(whole, values={**whole.values, "tilt_rate": whole["tilt_rate"] + blow}))[-1]
    assert last.status is Status.OK
    assert "lost the vehicle 1 times" in last.reason
    assert max(deviations_off(last).values()) < 4.0


# --- live, replayed, identified


def test_live_and_replayed_it_gives_the_same_bits() -> None:
    live, frames = bank(), list(run().frames(TWSBR))
    for place in range(0, len(frames), 10):
        live.update(frames[place : place + 10])
        if place == 1500:
            assert live.results() == {RECURSION: STARTING}
            live.join()
    assert live.complete
    results = live.results()
    assert results == replay(run(), VEHICLE)
    assert results[RECURSION]["status"] == "ok"
    assert results[RECURSION] == made_of(frames).to_json()


def made_of(frames: list[Frame]) -> Estimate:
    estimator = made()
    for frame in frames:
        estimator.update(frame)
    return estimator.result()


def test_identified_by_the_same_method_it_gives_the_same_numbers() -> None:
    document = identify(
        [run()], GIVEN["parameters"], VEHICLE.support, [RECURSION], deviations=GIVEN["deviations"], model=MODEL
    )
    entry = document["methods"][RECURSION]
    for name, each in course(1)[-1].parameters.items():
        told = entry["parameters"][name]
        assert (told["value"], told["std"]) == pytest.approx((each.value, each.std), rel=1e-6), name
