"""The effects that a virtual balancing robot can hide: what each does to its motion, and to nothing else."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from twsbr_plant import IMU, LOSSLESS, RATE, TRUTH, Balancer, balanced, drive, mass_matrix, robot, run_for

from upright.simulation.bus.imu_node import VirtualImu
from upright.simulation.config import SimulationConfig
from upright.simulation.kinds import machine
from upright.simulation.monocab.hidden import MONOCAB
from upright.simulation.registry import UnknownEffectError, parse_hidden, sizes_of
from upright.simulation.twsbr.effects import gear_effects, tilt_effects, wheel_effects
from upright.simulation.twsbr.hidden import TWSBR, TWSBR_HIDDEN, TWSBR_UNLISTED
from upright.simulation.twsbr.mechanics import PLACES

EVERY = (*TWSBR_HIDDEN, *TWSBR_UNLISTED)
FLOOR_DEG = math.degrees(TRUTH.floor_angle)


def with_imu(hidden: dict[str, float | None]) -> np.ndarray:
    """True tilt by cycle, (n,): two seconds from 3 deg, so that the wheels turn, balanced with the IMU."""
    onsets = {"torque_step": 0.5} if "torque_step" in hidden else {}
    config = SimulationConfig(plant=TRUTH, rate=RATE, imu=IMU, hidden=hidden, onsets=onsets)
    plant = machine(config)
    plant.event_origin = 0.0
    plant.place(math.radians(3.0))
    imu = VirtualImu(IMU, rate=RATE, seed=1, gravity=9.81, sizes=config.sizes, falling_axis=1)
    balancer, tilts = Balancer(6.0), []
    balancer.tilt = plant.tilt
    for _ in range(2 * RATE):
        volts = balancer.measured(*imu.measure(plant))
        tilts.append(plant.tilt)
        plant.advance(2)
        drive(plant, volts)
        plant.advance(8)
    return np.array(tilts)


@pytest.fixture(scope="module")
def bare() -> np.ndarray:
    return with_imu({})


def test_level_zero_equals_no_hidden_effects(bare: np.ndarray) -> None:
    assert np.array_equal(with_imu(dict.fromkeys(EVERY, 0.0)), bare)
    assert math.degrees(np.abs(bare[RATE:]).max()) < 1.0


@pytest.mark.parametrize("name", EVERY)
def test_each_hidden_effect_changes_the_motion_and_keeps_the_balance(name: str, bare: np.ndarray) -> None:
    """By more than 1e-5 rad, with the same noise.

    A larger effect need not change the motion more: with Stribeck friction the RMS difference of the tilt was
    0.45 deg here at level 1 and 0.43 deg at level 2. What must grow is the torque, see below.
    """
    hidden = with_imu({name: None})
    assert float(np.abs(hidden - bare).max()) > 1e-5
    assert math.degrees(float(np.abs(hidden).max())) < 5.0


TORQUES = [
    name
    for name in EVERY
    if tilt_effects({name: 1.0}, {}) or wheel_effects({name: 1.0}, {}) or gear_effects({name: 1.0}, {}, 5e-4)
]


@pytest.mark.parametrize("name", TORQUES)
def test_torque_at_the_same_motion_is_proportional_to_the_level(name: str) -> None:
    def torques(level: float) -> list[float]:
        sizes = sizes_of({name: level}, TWSBR)
        on_tilt = tilt_effects(sizes, {})
        on_wheel = (*wheel_effects(sizes, {}), *gear_effects(sizes, {}, 5e-4))
        wheel, found = robot().motors[0], []
        for step in range(24_000):
            time = step * 5e-4
            wheel.wheel_angle, wheel.wheel_rate = math.sin(5.0 * time), 5.0 * math.cos(5.0 * time)
            wheel.rotor_rate = wheel.wheel_rate
            wheel.torque = 0.2 * math.sin(7.0 * time)
            total = sum(effect(0.05 * math.sin(3.0 * time), time, time) for effect in on_tilt)
            found.append(total + sum(effect(wheel, time) for effect in on_wheel))
        return found

    once, twice = np.array(torques(1.0)), np.array(torques(2.0))
    assert np.abs(once).max() > 1e-3 * TRUTH.body_mass * TRUTH.gravity * TRUTH.centre_of_gravity_height
    assert twice == pytest.approx(2.0 * once, rel=1e-9, abs=1e-12)


def test_cubic_stiffness_does_not_lift_the_robot_off_its_bumper() -> None:
    """A torque that grew cubically up to 12 deg would lift it off: 1.8 N m against 0.07 N m of gravity."""
    plant = robot(hide=["cubic_stiffness=2"])
    run_for(plant, 2.0)
    assert math.degrees(plant.tilt) == pytest.approx(FLOOR_DEG, abs=0.1)


def test_slope_pulls_the_robot_back_by_its_weight() -> None:
    """Held on wheels that turn freely: acceleration r (m_b + 2 m_w) g r sin(slope) over the inertia of travel."""
    plant = robot(replace(LOSSLESS, start="held"), ["slope"])
    run_for(plant, 0.2)
    inertia = mass_matrix(LOSSLESS, 0.0)[0, :2].sum() * 2.0
    weight = (TRUTH.body_mass + 2.0 * TRUTH.wheel_mass) * 9.81 * math.sin(TWSBR_HIDDEN["slope"].size)
    expected = -0.5 * TRUTH.wheel_radius**2 * weight / inertia * 0.2**2
    assert plant.travelled == pytest.approx(expected, rel=1e-6)


def test_motor_crosses_the_backlash_before_the_wheel_turns() -> None:
    plant = robot(hide=["backlash"])
    plant.hold()
    drive(plant, 1.0)
    backlash_width = TWSBR_HIDDEN["backlash"].size
    while plant.state[3] < 0.45 * backlash_width:
        plant.step()
        assert plant.motors[0].wheel_angle == 0.0
    run_for(plant, 0.06)
    assert plant.motors[0].wheel_angle > 0.0
    assert plant.state[3] - plant.motors[0].wheel_angle == pytest.approx(0.5 * backlash_width, rel=0.5)


def test_gear_with_little_backlash_does_not_oscillate_against_the_controller() -> None:
    """With a backlash of 1e-6 rad, its wheels vibrate from cycle to cycle as without: 0.046 rad/s RMS, and 0.073 if
    shaft and teeth have four times the compliance and half the damping."""
    runs = (balanced(hide=hide, seconds=4.0, tilt_deg=0.5)[RATE:, 1] for hide in ((), ("backlash=1e-3",)))
    stiff, loose = (float(np.std(np.diff(run, 2))) for run in runs)
    assert loose == pytest.approx(stiff, rel=0.1)


def test_gear_with_little_backlash_behaves_as_a_stiff_gear() -> None:
    """With open bridges, a backlash of 1e-6 rad and compliant teeth change a fall of 4 deg by less than 0.5 %."""
    stiff, loose = robot(), robot(hide=["backlash=1e-3"])
    for plant in (stiff, loose):
        plant.place(math.radians(2.0))
        run_for(plant, 0.2)
    assert math.degrees(stiff.tilt) > 3.0
    assert loose.tilt == pytest.approx(stiff.tilt, rel=5e-3)


def test_dry_friction_holds_the_wheels_below_its_breakaway_torque() -> None:
    """0.2 V give 11 mN m at a wheel, its gear has 30 mN m of friction: bristles, which slide from 0.2 mrad on, ring."""
    loose, stuck = robot(), robot(hide=["coulomb_friction=3"])
    for plant in (loose, stuck):
        plant.hold()
        drive(plant, 0.2)
        run_for(plant, 0.09)
        plant.hold()
        run_for(plant, 0.09)
    assert abs(stuck.motors[0].wheel_angle) < 4e-4
    assert loose.motors[0].wheel_angle > 2.5e-3


def test_weak_battery_sags_under_the_current_of_both_motors() -> None:
    """At standstill: current = U / (R + 2 R_battery) in each motor; the wheels are kept from turning."""
    plant = robot(hide=["test_battery_sag"])
    plant.hold()
    drive(plant, 12.0)
    for _ in range(50):
        plant.step()
        plant.state = (0.0,) * (2 * PLACES)
    # The state is reset after each step, so the rotors accelerate for half a millisecond: 1 % of the current.
    assert plant.motors[0].current == pytest.approx(12.0 / (TRUTH.resistance + 2.0 * 0.6), rel=0.015)


def test_effect_changes_nothing_before_its_onset() -> None:
    late = balanced(["viscous_friction=2@0.8"], seconds=1.6, tilt_deg=3.0)
    never = balanced(seconds=1.6, tilt_deg=3.0)
    changed = np.flatnonzero(late[:, 0] != never[:, 0])
    assert changed[0] / RATE == pytest.approx(0.8, abs=0.011)


def test_robot_has_its_own_registry_of_effects() -> None:
    assert all(name.startswith("test_") for name in TWSBR_UNLISTED)
    assert not any(name.startswith("test_") for name in TWSBR_HIDDEN)
    assert set(EVERY) >= TWSBR.late
    assert sizes_of({"input_deadband": 2.0}, TWSBR) == {"input_deadband": 1.2}
    with pytest.raises(UnknownEffectError, match="slope"):
        parse_hidden(["gimbal_imbalance"], TWSBR)
    with pytest.raises(UnknownEffectError, match="from the beginning"):
        robot(hide=["backlash@3"])
    with pytest.raises(UnknownEffectError, match="slope"):
        sizes_of({"slope": None}, MONOCAB)
