"""The virtual balancing robot: mechanics against the paper's matrices and closed formulas; in the loop; its IMU."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from twsbr_plant import IMU, LOSSLESS, PITCH, RATE, TRUTH, balanced, drive, mass_matrix, robot, run_for

from upright.simulation.bus.imu_node import VirtualImu
from upright.simulation.twsbr.mechanics import PLACES
from upright.simulation.twsbr.motor import Encoder
from upright.simulation.twsbr.plant import RELEASE_DELAY, TRAVEL, TURN, TwsbrPlant
from upright.simulation.twsbr.truth import TwsbrTruth

FLOOR_DEG = math.degrees(TRUTH.floor_angle)


def energy(plant: TwsbrPlant, truth: TwsbrTruth) -> float:
    """J, from the paper's matrix and the height of the body above the axle."""
    state = plant.state
    forward, swing, tip = state[PLACES : PLACES + 3]
    rates = np.array([forward - swing, forward + swing, tip])
    potential = truth.body_mass * truth.gravity * truth.centre_of_gravity_height * math.cos(plant.tilt)
    return float(0.5 * rates @ mass_matrix(truth, plant.tilt) @ rates) + potential


# --- mechanics


def test_energy_is_conserved_without_friction_and_with_open_bridges() -> None:
    """Four seconds of falling and swinging below the axle, without a floor, while it spins; a fourth-order integrator.

    At 0.5 ms and rates of 20 rad/s its error per step is below 1e-9 of the oscillating energy; 8000 steps are allowed.
    """
    plant = robot(LOSSLESS)
    plant.place(0.4)
    state = list(plant.state)
    state[PLACES + TURN], state[PLACES + TRAVEL] = 8.0, 3.0
    plant.state = tuple(state)
    start, lowest, worst = energy(plant, LOSSLESS), 0.0, 0.0
    for _ in range(400):
        plant.advance(20)
        lowest = min(lowest, math.cos(plant.tilt))
        worst = max(worst, abs(energy(plant, LOSSLESS) - start))
    assert lowest < -0.9, "or it has not swung"
    assert worst < 1e-5 * 2.0 * plant.mechanics.gravity_stiffness


def test_upright_is_unstable_with_the_pole_of_the_papers_matrices() -> None:
    """Released at 1e-4 rad it falls as cosh(pole t), pole^2 from M^-1 and gravity; the sine changes that by 1e-6."""
    plant = robot(LOSSLESS)
    plant.place(1e-4)
    run_for(plant, 0.5)
    pole = math.sqrt(np.linalg.inv(mass_matrix(LOSSLESS, 0.0))[2, 2] * plant.mechanics.gravity_stiffness)
    assert plant.tilt == pytest.approx(1e-4 * math.cosh(pole * plant.time), rel=1e-4)
    assert plant.tilt > 1e-3


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_released_robot_falls_and_rests_on_a_bumper(side: float) -> None:
    plant = robot()
    plant.place(side * math.radians(0.5))
    run_for(plant, 6.0)
    assert plant.tilt == pytest.approx(
        side * plant.mechanics.floor.resting_roll(plant.mechanics.gravity_stiffness), abs=1e-5
    )
    assert abs(plant.tilt_rate) < 1e-4
    assert math.degrees(abs(plant.tilt)) == pytest.approx(FLOOR_DEG, abs=0.1)


def test_robot_starts_at_rest_on_its_front_bumper() -> None:
    plant = robot()
    start = plant.tilt
    run_for(plant, 1.0)
    assert plant.tilt == pytest.approx(start, abs=1e-9)
    assert plant.travelled == pytest.approx(start * TRUTH.wheel_radius, abs=1e-9)
    assert [motor.measured_position for motor in plant.motors] == [0.0, 0.0]


def test_held_robot_reaches_the_speed_given_by_the_motor_equation(monkeypatch: pytest.MonkeyPatch) -> None:
    """n K / R (U - n K w) = (b + f_v) w, with the bridge's U; after eleven time constants of 0.45 s."""
    plant = robot(replace(TRUTH, start="held"))
    monkeypatch.setattr("upright.simulation.twsbr.plant.RELEASE_DELAY", math.inf)
    drive(plant, 6.0)
    run_for(plant, 5.0)
    constant = TRUTH.gear_ratio * TRUTH.torque_constant
    gain = constant / TRUTH.resistance
    volts = plant.motors[0].demand
    expected = gain * volts / (gain * constant + TRUTH.motor_friction + TRUTH.wheel_friction)
    assert plant.motors[0].wheel_rate == pytest.approx(expected, rel=1e-4)
    assert volts == pytest.approx(6.0, abs=0.5 * 12.0 / 255)


def test_stand_releases_the_robot_once_the_motors_are_powered() -> None:
    plant = robot(replace(TRUTH, start="held"))
    run_for(plant, 0.5)
    assert plant.tilt == 0.0
    drive(plant, 0.5)
    run_for(plant, 0.9 * RELEASE_DELAY)
    assert plant.tilt == 0.0
    run_for(plant, 0.3)
    assert plant.tilt != 0.0
    assert not plant.mechanics.held_upright


def test_faster_right_wheel_turns_the_robot_left() -> None:
    plant = robot()
    plant.hold()
    drive(plant, 2.0, 4.0)
    run_for(plant, 0.08)
    left, right = plant.motors
    assert right.wheel_rate > left.wheel_rate > 0.0
    assert plant.yaw == pytest.approx(
        TRUTH.wheel_radius * (right.wheel_angle - left.wheel_angle) / TRUTH.wheel_distance
    )
    assert plant.yaw > 0.0


def test_open_bridges_carry_no_current_and_a_shorted_motor_brakes() -> None:
    def left_after(powered: bool) -> float:
        plant = robot()
        plant.hold()
        drive(plant, 6.0)
        run_for(plant, 0.09)
        drive(plant, 0.0)
        for motor in plant.motors:
            motor.powered = powered
        plant.hold()
        state = list(plant.state)
        state[PLACES + TRAVEL] = 10.0
        plant.state = tuple(state)
        run_for(plant, 0.09)
        assert powered or plant.motors[0].current == 0.0
        return plant.motors[0].wheel_rate

    assert left_after(powered=True) < 0.9 * left_after(powered=False)


# --- motor, bridge, encoder


def test_bridge_voltage_is_limited_to_the_supply_and_quantised() -> None:
    plant = robot()
    motor = plant.motors[0]
    for target in np.linspace(-15.0, 15.0, 1001):
        drive(plant, float(target))
        motor.set_voltage(12.0)
        assert abs(motor.duty) <= 1.0
        steps = motor.duty * 255
        assert steps == pytest.approx(round(steps), abs=1e-9)
        assert motor.limited == (abs(target) > 12.0)
        assert motor.demand == pytest.approx(max(-12.0, min(12.0, target)), abs=0.5 * 12.0 / 255 + 1e-9)


def test_encoder_counts_and_times_its_edges() -> None:
    """At a steady speed the rate is exact after two edges; at rest it decays as one count per time since the last."""
    for rate in (0.3, -2.0, 25.0, -60.0):
        encoder = Encoder(PITCH, 5e-4)
        for step in range(1, 400):
            encoder.read(rate * step * 5e-4)
        assert encoder.rate == pytest.approx(rate, rel=1e-6)
        assert encoder.position / PITCH == pytest.approx(round(rate * 399 * 5e-4 / PITCH), abs=1e-6)
        for _ in range(1000):
            encoder.read(rate * 399 * 5e-4)
        assert abs(encoder.rate) <= PITCH / 0.5


def test_reversals_across_one_edge_give_no_speed() -> None:
    encoder = Encoder(1.0, 1.0)
    for angle in (0.2, 0.7, 0.3, 0.6, 0.4):
        encoder.read(angle)
    assert encoder.rate == 0.0


# --- in the loop


def test_pd_control_balances_the_robot_through_the_square_wave() -> None:
    """8 V at 5 rad/s on the motor voltage, 200 Hz: within 3 deg, and more than half of 8 V / (25 V/deg)."""
    run = balanced(seconds=6.0, tilt_deg=0.5)
    excited = np.degrees(np.abs(run[RATE:, 0]))
    assert excited.max() < 3.0
    assert excited.max() > 0.5 * 8.0 / 25.0


def test_robot_falls_under_the_square_wave_without_control() -> None:
    plant = robot()
    plant.place(0.0)
    for cycle in range(3 * RATE):
        drive(plant, math.copysign(8.0, math.sin(5.0 * cycle / RATE)))
        plant.advance(10)
    assert abs(math.degrees(plant.tilt)) > 5.0


def test_robot_rises_from_either_bumper() -> None:
    for start in (None, -FLOOR_DEG):
        run = balanced(seconds=2.0, tilt_deg=start, amplitude=0.0)
        assert math.degrees(abs(run[0, 0])) > 11.9
        assert math.degrees(np.abs(run[-RATE // 2 :, 0]).max()) < 0.5


# --- IMU


def test_imu_measures_the_motion_of_its_position() -> None:
    """Compared with differences of the sensor's pose in the world, while the robot falls, drives and turns."""
    plant = robot()
    plant.place(0.1)
    drive(plant, 2.0, 12.0)
    heading, place, axes = [0.0, 0.0], [], []
    before = (plant.travelled, plant.yaw)
    for _ in range(101):
        plant.step()
        yaw = 0.5 * (before[1] + plant.yaw)
        heading[0] += (plant.travelled - before[0]) * math.cos(yaw)
        heading[1] += (plant.travelled - before[0]) * math.sin(yaw)
        before = (plant.travelled, plant.yaw)
        s, c, sy, cy = math.sin(plant.tilt), math.cos(plant.tilt), math.sin(plant.yaw), math.cos(plant.yaw)
        columns = np.array([[c * cy, -sy, s * cy], [c * sy, cy, s * sy], [-s, 0.0, c]])
        place.append(np.array([*heading, 0.0]) + columns @ (0.02, 0.03, 0.06))
        axes.append(columns)
        if len(place) == 100:
            felt, angular = plant.felt(plant.motion(), (0.02, 0.03, 0.06), 9.81)
    h = plant.step_size
    acceleration = (place[100] - 2.0 * place[99] + place[98]) / h**2
    assert felt == pytest.approx(axes[99].T @ (acceleration + np.array([0.0, 0.0, 9.81])), abs=2e-3)
    spin = axes[99].T @ (axes[100] - axes[98]) / (2.0 * h)
    assert angular == pytest.approx((spin[2, 1], spin[0, 2], spin[1, 0]), abs=1e-4)
    assert min(abs(x) for x in angular) > 0.05, "or it would not have turned about every axis"


def test_hidden_gyro_bias_acts_on_the_tilt_axis() -> None:
    quiet = replace(IMU, angular_rate_density=0.0, bias_random_walk=0.0, angular_rate_bias=(0.0, 0.0, 0.0))
    plant = robot()
    imu = VirtualImu(quiet, rate=RATE, seed=1, gravity=9.81, sizes={"gyro_bias": 0.1}, falling_axis=1)
    assert imu.measure(plant)[1] == pytest.approx((0.0, 0.1, 0.0), abs=1e-9)
