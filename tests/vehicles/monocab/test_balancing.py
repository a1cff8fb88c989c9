"""The controller, the rise and the lowering with the plant of `roll_plant`, at every IMU rate."""

from __future__ import annotations

import math
from dataclasses import replace
from enum import Enum
from itertools import pairwise

import pytest
from roll_plant import RATES, SETTLE, Log, Plant, balance, designed, get_down, get_up, peak, vehicle_at

from upright.vehicles.experiment.excitation import make_excitation
from upright.vehicles.file import load
from upright.vehicles.monocab.control.rise import RiseState, lowering_side, lowering_travel
from upright.vehicles.monocab.file import TRIM_RATE


@pytest.mark.parametrize("rate", RATES)
@pytest.mark.parametrize("delay", [0, 1, 2])
@pytest.mark.parametrize("side", [1.0, -1.0])
def test_vehicle_rises_is_caught_and_balances_for_20_s(rate: int, delay: int, side: float) -> None:
    vehicle = vehicle_at(rate)
    plant, log = Plant(vehicle.period, delay=delay, side=side), Log()
    rise, controller = get_up(vehicle, plant, log)
    balance(vehicle, plant, log, controller, "settle", SETTLE)
    balance(vehicle, plant, log, controller, "hold", 20.0)

    assert rise.done
    # Most of this is due to the lean that brings the gimbals back, not to the catch.
    assert peak(log.roll["settle"][round(0.3 * rate) :]) < 2.0
    assert side * min(side * value for value in log.roll["settle"]) > -2.0
    assert peak(log.roll["hold"][10 * rate :]) < 0.05
    assert abs(log.precession["hold"][-1]) < 0.5
    assert log.largest_precession() < 25.0


BALANCED = sorted(name for name, each in load("monocab").experiments.items() if each.gets_up and each.at != TRIM_RATE)
"""The experiments for a vehicle that gets up; this plant has no trim mass."""


@pytest.mark.parametrize("rate", RATES)
@pytest.mark.parametrize("name", BALANCED)
def test_every_shipped_experiment_stays_in_bounds_and_ends_at_rest(name: str, rate: int) -> None:
    vehicle = vehicle_at(rate)
    excitation = make_excitation(vehicle.experiments[name], rate)
    side = -1.0 if name == "step" else 1.0
    plant, log = Plant(vehicle.period, delay=2 if rate == 500 else 1, side=side), Log()
    _, controller = get_up(vehicle, plant, log)
    balance(vehicle, plant, log, controller, "settle", SETTLE)
    balance(vehicle, plant, log, controller, "excite", excitation.duration, excitation)
    balance(vehicle, plant, log, controller, "fade", 1.5)
    get_down(vehicle, plant, log, controller, side)

    assert peak(log.roll["excite"]) < 2.0
    assert peak(log.precession["excite"]) < 15.0
    assert log.largest_precession() < 30.0
    # The rate limit would turn the excitation into another signal.
    assert peak(log.setpoint["excite"]) < vehicle.limits.precession_rate
    assert plant.carried
    assert log.roll["rest"][-1] == pytest.approx(side * 4.0, abs=0.1)
    assert log.setpoint["lower"][-1] == 0.0
    if excitation.peak and name != "step":
        # At least ten times the noise of the roll angle (0.009 deg), or the record is of no use for identification.
        mean = sum(log.roll["excite"]) / len(log.roll["excite"])
        rms = math.sqrt(sum((value - mean) ** 2 for value in log.roll["excite"]) / len(log.roll["excite"]))
        assert rms > 0.09


def person_sits_down(t: float) -> float:
    return 550.0 * min(1.0, max(0.0, (t - 11.0) / 0.5))


@pytest.mark.parametrize("rate", RATES)
def test_vehicle_leans_against_the_load_of_a_person_who_sits_down(rate: int) -> None:
    vehicle = vehicle_at(rate)
    plant, log = Plant(vehicle.period, load=person_sits_down), Log()
    _, controller = get_up(vehicle, plant, log)
    balance(vehicle, plant, log, controller, "before", 10.0 - plant.time)
    balance(vehicle, plant, log, controller, "loaded", 40.0)

    assert peak(log.roll["loaded"]) < 3.0
    assert peak(log.precession["loaded"]) < 25.0
    # At the end the vehicle leans against the load with its gimbals centred: roll = -550 / 14500 rad.
    assert log.roll["loaded"][-1] == pytest.approx(math.degrees(-550.0 / 14500.0), abs=0.1)
    assert abs(log.precession["loaded"][-1]) < 3.0


def test_without_lean_a_person_changes_the_roll_angle_by_less_than_0_3_deg() -> None:
    """The disturbance response of the roll loop alone; figure 4 of the paper shows 0.05 deg, with the trim mass."""
    vehicle = vehicle_at(250)
    plant, log = Plant(vehicle.period, load=person_sits_down), Log()
    _, controller = get_up(vehicle, plant, log)
    balance(vehicle, plant, log, controller, "before", 10.0 - plant.time)
    controller.lean_on = False
    balance(vehicle, plant, log, controller, "loaded", 2.5)
    assert peak(log.roll["loaded"]) < 0.3


@pytest.mark.parametrize("rate", RATES)
def test_static_torque_of_50_nm_does_not_saturate_the_gimbals_within_a_minute(rate: int) -> None:
    vehicle = vehicle_at(rate)
    plant, log = Plant(vehicle.period, load=lambda t: 50.0), Log()
    _, controller = get_up(vehicle, plant, log)
    balance(vehicle, plant, log, controller, "minute", 60.0)
    assert log.largest_precession() < 25.0
    assert abs(log.precession["minute"][-1]) < 0.5


def test_without_precession_return_a_static_torque_makes_the_gimbals_drift() -> None:
    """The paper's reduced controller: 50 N m turn the gimbals by 50 / 3300 rad/s, 17 deg in 20 s."""
    vehicle = vehicle_at(250)
    section = vehicle.controller.model_copy(update={"precession_return_time": 0.0})
    vehicle = vehicle.model_copy(update={"controller": section})
    plant, log = Plant(vehicle.period, load=lambda t: 50.0), Log()
    _, controller = get_up(vehicle, plant, log)
    balance(vehicle, plant, log, controller, "settle", SETTLE)
    balance(vehicle, plant, log, controller, "hold", 20.0)
    drift = log.precession["hold"][-1] - log.precession["hold"][0]
    assert drift == pytest.approx(math.degrees(-50.0 / 3300.0 * 20.0), rel=0.03)


def test_vehicle_balances_with_gyro_torque_proportional_to_cosine_of_precession() -> None:
    vehicle = vehicle_at(250)
    excitation = make_excitation(vehicle.experiments["multisine"], 250.0)
    plant, log = Plant(vehicle.period, gimbal_coupling=True, load=lambda t: 100.0), Log()
    _, controller = get_up(vehicle, plant, log)
    balance(vehicle, plant, log, controller, "settle", SETTLE)
    balance(vehicle, plant, log, controller, "excite", excitation.duration, excitation)
    assert peak(log.roll["excite"]) < 3.0
    assert log.largest_precession() < 30.0


class HeldDown(Enum):
    """Causes of a failed rise: (reason, rise rate, holding torque, roll angle below which it acts)."""

    TOO_WEAK = ("did not lift off", 0.25, 0.0, 0.0)
    BALLAST = ("did not lift off", None, 600.0, 1.0)
    OBSTACLE = ("lifted off but was not upright", None, 3000.0, 0.04)


@pytest.mark.parametrize("case", HeldDown)
def test_failed_rise_reports_its_reason_and_leaves_the_vehicle_on_its_support(case: HeldDown) -> None:
    words, rate, torque, below = case.value
    vehicle = vehicle_at(250)
    plant, log = Plant(vehicle.period, held_down=lambda roll: torque if roll < below else 0.0), Log()
    rise, _ = get_up(vehicle, plant, log, rate)
    assert rise.state is RiseState.FAILED
    assert words in rise.failure
    assert "rad/s" in rise.failure
    assert rise.setpoint == 0.0
    assert log.largest_precession() < vehicle.limits.precession_budget_deg
    for _ in range(500):
        plant.step(0.0)
    assert plant.carried
    steps = [abs(b - a) for a, b in pairwise(log.setpoint["rise"])]
    assert max(steps) <= vehicle.limits.precession_acceleration * vehicle.period + 1e-12


def test_lowering_onto_a_support_beyond_the_angle_in_the_file_ends_at_rest() -> None:
    vehicle = vehicle_at(250)
    plant, log = Plant(vehicle.period, support=math.radians(4.6)), Log()
    _, controller = get_up(vehicle, plant, log)
    balance(vehicle, plant, log, controller, "settle", SETTLE)
    get_down(vehicle, plant, log, controller, 1.0)
    assert plant.carried
    assert log.roll["rest"][-1] == pytest.approx(4.6, abs=0.1)
    assert peak(log.roll["lower"]) < vehicle.limits.roll_deg


def test_lowering_with_gimbals_at_the_budget_uses_the_side_that_turns_them_back() -> None:
    """Lowering to the side it came from would exceed the hard limit; the other side turns the gimbals back."""
    vehicle = vehicle_at(250)
    parameters = designed(250).parameters
    plant, log = Plant(vehicle.period), Log()
    _, controller = get_up(vehicle, plant, log)
    balance(vehicle, plant, log, controller, "settle", SETTLE)
    budget = math.radians(vehicle.limits.precession_budget_deg)
    plant.precession = -budget
    travel = lowering_travel(parameters, vehicle.support)
    side = lowering_side(1.0, plant.precession, travel, budget)
    assert side == -1.0
    get_down(vehicle, plant, log, controller, side)
    assert plant.carried
    assert peak(log.precession["lower"]) < vehicle.limits.precession_deg
    assert lowering_side(1.0, -0.1, travel, budget) == 1.0
    assert lowering_side(-1.0, 0.1, travel, budget) == -1.0


def test_precession_during_lowering_is_bounded_by_the_momentum_balance() -> None:
    vehicle = vehicle_at(250)
    plant, log = Plant(vehicle.period), Log()
    _, controller = get_up(vehicle, plant, log)
    balance(vehicle, plant, log, controller, "settle", 20.0)
    get_down(vehicle, plant, log, controller, 1.0)
    travel = log.precession["lower"][0] - min(log.precession["lower"])
    parameters = replace(designed(250).parameters, gravity_stiffness=plant.gravity_stiffness)
    # Roll leads the reference and touches down with some rate, so the estimate is an upper bound.
    estimate = math.degrees(lowering_travel(parameters, vehicle.support))
    assert 0.3 * estimate < travel < estimate
