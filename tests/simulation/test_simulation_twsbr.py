"""The virtual balancing robot: mechanics against the paper's matrices and closed formulas; its nodes on the bus."""

from __future__ import annotations

import math
import struct
import threading
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import can
import canopen
import numpy as np
import pytest
from simulated_bus import DISABLE_VOLTAGE, MASTER, QUICK_STOP, SHUTDOWN, SWITCH_ON, Harness

from upright.drivers.imu.imu import Imu
from upright.drivers.imu.layout import ImuConfig
from upright.simulation.bus.imu_node import VirtualImu
from upright.simulation.bus.object_dictionary import SimulationError
from upright.simulation.bus.power_state import PowerState
from upright.simulation.config import DriveNode, ImuNode, SimulationConfig
from upright.simulation.faults import parse_faults
from upright.simulation.kinds import machine
from upright.simulation.monocab.hidden import MONOCAB
from upright.simulation.registry import UnknownEffectError, parse_hidden, sizes_of
from upright.simulation.runner import Runner
from upright.simulation.twsbr.effects import gear_effects, tilt_effects, wheel_effects
from upright.simulation.twsbr.hidden import TWSBR, TWSBR_HIDDEN, TWSBR_UNLISTED
from upright.simulation.twsbr.mechanics import PLACES
from upright.simulation.twsbr.motor import Encoder
from upright.simulation.twsbr.plant import RELEASE_DELAY, TRAVEL, TURN, TwsbrPlant
from upright.simulation.twsbr.truth import TwsbrTruth
from upright.telemetry.samples import CanFrame

EDS = Path(__file__).resolve().parents[2] / "drivers" / "eds" / "upright_motor.eds"
RATE = 200
TRUTH = TwsbrTruth()
IMU = ImuNode(position=(0.01, 0.0, 0.06))
LOSSLESS = replace(TRUTH, motor_friction=0.0, wheel_friction=0.0, floor_angle=100.0)
"""Without friction, and without a floor, so that the body can hang."""
EVERY = (*TWSBR_HIDDEN, *TWSBR_UNLISTED)
PITCH = 2.0 * math.pi / TRUTH.encoder_counts_per_turn
FLOOR_DEG = math.degrees(TRUTH.floor_angle)
ENABLE = 0x0F


def robot(truth: TwsbrTruth = TRUTH, hide: Sequence[str] = (), **options: object) -> TwsbrPlant:
    hidden, onsets = parse_hidden(hide, TWSBR)
    config = SimulationConfig(plant=truth, rate=RATE, imu=IMU, hidden=hidden, onsets=onsets, **options)  # type: ignore[arg-type]
    return machine(config)


def run_for(plant: TwsbrPlant, seconds: float) -> None:
    plant.advance(round(seconds / plant.step_size))


def drive(plant: TwsbrPlant, left: float, right: float | None = None) -> None:
    for motor, volts in zip(plant.motors, (left, left if right is None else right), strict=True):
        motor.powered, motor.target = True, volts


def mass_matrix(truth: TwsbrTruth, tilt: float) -> np.ndarray:
    """(3, 3), equations (16) to (19) of the paper, by left and right wheel angle and tilt."""
    r, height, distance = truth.wheel_radius, truth.centre_of_gravity_height, truth.wheel_distance
    body, rotor = truth.body_mass, truth.gear_ratio**2 * truth.rotor_inertia
    yaw = (height * r / distance) ** 2 * body * math.sin(tilt) ** 2 + truth.yaw_inertia * (r / distance) ** 2
    own = 1.5 * truth.wheel_mass * r**2 + 0.25 * body * r**2 + rotor + yaw
    other = 0.25 * body * r**2 - yaw
    mixed = 0.5 * body * height * r * math.cos(tilt) - rotor
    last = body * height**2 + truth.tilt_inertia + 2.0 * rotor
    return np.array([[own, other, mixed], [other, own, mixed], [mixed, mixed, last]])


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


class Balancer:
    """PD control of the tilt in degrees, and from 1 s on the paper's square wave on the voltage; `measured`: by IMU."""

    def __init__(self, amplitude: float) -> None:
        self.amplitude = amplitude
        self.time = 0.0
        self.tilt: float | None = None

    def __call__(self, tilt: float, rate: float) -> float:
        self.time += 1.0 / RATE
        square = math.copysign(self.amplitude, math.sin(5.0 * self.time)) if self.time > 1.0 else 0.0
        volts = 25.0 * math.degrees(tilt) + 3.5 * math.degrees(rate)
        return max(-12.0, min(12.0, volts)) + square

    def measured(self, acceleration: Sequence[float], angular_rate: Sequence[float]) -> float:
        """V, for the tilt from a complementary filter of 5 s: the axle's acceleration would disturb a faster one."""
        lean = math.atan2(-acceleration[0], acceleration[2])
        turned = angular_rate[1] / RATE
        self.tilt = lean if self.tilt is None else self.tilt + turned + 0.001 * (lean - self.tilt)
        return self(self.tilt, angular_rate[1])


def balanced(hide: Sequence[str] = (), *, seconds: float, tilt_deg: float | None, amplitude: float = 8.0) -> np.ndarray:
    """True tilt and wheel rate by cycle, (n, 2); with an ideal sensor."""
    plant = robot(hide=hide)
    plant.event_origin = 0.0
    if tilt_deg is not None:
        plant.place(math.radians(tilt_deg))
    balancer, rows = Balancer(amplitude), []
    for _ in range(round(seconds * RATE)):
        volts = balancer(plant.tilt, plant.tilt_rate)
        rows.append((plant.tilt, plant.motors[0].wheel_rate))
        plant.advance(2)
        drive(plant, volts)
        plant.advance(8)
    return np.array(rows)


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


# --- hidden effects


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


# --- on the bus


def wheel_nodes(**changes: object) -> tuple[DriveNode, ...]:
    """The two motor controllers, in units of a wheel turn; the right one is mirrored."""
    node = DriveNode(
        name="left_wheel",
        role="wheel",
        node=1,
        direction=1,
        axis_per_turn=2.0 * math.pi,
        increments_per_turn=700,
        velocity_unit_rpm=1.0 / 8192.0,
        rated_torque=0.5,
        eds=EDS,
        mode=-1,
        rpdo=(("controlword", "target_voltage"),),
        tpdo=(("statusword", "position_actual"), ("velocity_actual", "torque_actual")),
    )
    nodes = (node, replace(node, name="right_wheel", node=2, direction=-1))
    return tuple(replace(node, **changes) for node in nodes)  # type: ignore[arg-type]


def configuration(truth: TwsbrTruth = TRUTH) -> SimulationConfig:
    return SimulationConfig(drives=wheel_nodes(), plant=truth, rate=RATE, imu=IMU)


class Robot(Harness):
    """The master of the other tests, with volts instead of rpm and with two nodes."""

    def set_up(self, mode: int = -1, timeout_ms: int = 120, reaction: int = 3) -> None:
        for node in (1, 2):
            assert self.sdo(node, 0x6060, 0, mode, 1) >= 0
            assert self.sdo(node, 0x1016, 1, MASTER << 16 | timeout_ms) >= 0
            assert self.sdo(node, 0x6007, 0, reaction, 2) >= 0
        self.nmt(1)

    def cycle(self, controlword: int, volts: float = 0.0, *, heartbeat: bool = True, rpdo: bool = True) -> None:
        if rpdo:
            for node, sign in ((1, 1), (2, -1)):
                target = round(sign * volts * 1000.0)
                self.vehicle.receive(0x200 + node, struct.pack("<Hh", controlword, target))
        self.vehicle.advance_steps(self.config.steps_per_ms)
        self.vehicle.receive(0x080, b"")
        if heartbeat:
            self.vehicle.receive(0x700 + MASTER, b"\x05")
        self.vehicle.advance_steps(self.config.steps_per_period - self.config.steps_per_ms)
        self.vehicle.begin_cycle()

    def enable(self) -> None:
        for controlword in (DISABLE_VOLTAGE, SHUTDOWN, SWITCH_ON, ENABLE):
            self.cycles(0.1, controlword)

    @property
    def robot(self) -> TwsbrPlant:
        assert isinstance(self.vehicle.plant, TwsbrPlant)
        return self.vehicle.plant

    @property
    def states(self) -> list[PowerState]:
        return [drive.state for drive in self.vehicle.drives.values()]

    def actual(self, node: int) -> tuple[int, int, int, int]:
        """Statusword, position, velocity and torque as last sent by the drive."""
        word, position = struct.unpack("<Hi", self.frames(0x180 + node)[-1])
        return word, position, *struct.unpack("<ih", self.frames(0x280 + node)[-1])


@pytest.fixture
def bus() -> Robot:
    bus = Robot(configuration())
    bus.set_up()
    return bus


def test_master_enables_both_motors_in_voltage_mode(bus: Robot) -> None:
    bus.enable()
    words = [struct.unpack_from("<H", data)[0] & 0x6F for data in bus.frames(0x181)]
    assert [word for i, word in enumerate(words) if i == 0 or word != words[i - 1]] == [0x00, 0x40, 0x21, 0x23, 0x27]
    assert bus.states == [PowerState.OPERATION_ENABLED] * 2
    assert bus.sdo(1, 0x6061) & 0xFF == 0xFF
    assert bus.sdo(1, 0x6502) == 1 << 16
    assert bus.sdo(1, 0x6060, 0, 2, 1) == -0x06090030


def test_target_voltage_turns_both_wheels_forward(bus: Robot) -> None:
    """2 V lift the robot off its bumper and throw it onto the other one; on the way both encoders count forwards."""
    bus.enable()
    bus.cycles(0.05, ENABLE, 2.0)
    assert bus.sdo(1, 0x2401) == pytest.approx(2000, abs=24)
    for node, sign in ((1, 1), (2, -1)):
        _, position, velocity, torque = bus.actual(node)
        motor = bus.robot.motors[node - 1]
        assert sign * position * PITCH == pytest.approx(motor.measured_position, abs=3.0 * PITCH)
        assert sign * position > 0
        assert sign * velocity > 0
        assert sign * torque > 0
    assert bus.robot.motors[0].wheel_rate == pytest.approx(bus.robot.motors[1].wheel_rate, rel=1e-9)


def test_voltage_beyond_the_supply_is_limited_and_reported(bus: Robot) -> None:
    bus.enable()
    bus.cycle(ENABLE, 12.0)
    assert not bus.actual(1)[0] & 0x800
    bus.cycles(0.02, ENABLE, 14.0)
    assert bus.actual(1)[0] & 0x800
    assert bus.sdo(1, 0x2401) == 12_000
    assert bus.robot.motors[0].demand == 12.0


@pytest.mark.parametrize("controlword", [ENABLE | 0x100, SWITCH_ON])
def test_halt_and_disable_remove_the_voltage(bus: Robot, controlword: int) -> None:
    bus.enable()
    bus.cycles(0.05, ENABLE, 3.0)
    bus.cycles(0.05, controlword, 3.0)
    assert [motor.target for motor in bus.robot.motors] == [0.0, 0.0]


def test_motors_without_a_mode_have_no_voltage() -> None:
    bus = Robot(configuration())
    bus.nmt(1)
    bus.enable()
    bus.cycles(0.05, ENABLE, 3.0)
    assert bus.states == [PowerState.OPERATION_ENABLED] * 2
    assert [motor.duty for motor in bus.robot.motors] == [0.0, 0.0]


def test_quick_stop_shorts_the_motors_and_then_opens_the_bridges(bus: Robot) -> None:
    bus.enable()
    bus.cycles(0.1, ENABLE, 6.0)
    bus.cycle(QUICK_STOP, 6.0)
    assert bus.states == [PowerState.QUICK_STOP_ACTIVE] * 2
    assert [(motor.powered, motor.target) for motor in bus.robot.motors] == [(True, 0.0)] * 2
    bus.cycles(2.2, QUICK_STOP)
    assert bus.states == [PowerState.SWITCH_ON_DISABLED] * 2
    assert not any(motor.powered for motor in bus.robot.motors)


def test_loss_of_the_masters_heartbeat_removes_the_voltage(bus: Robot) -> None:
    bus.enable()
    bus.cycles(0.135, ENABLE, 4.0, heartbeat=False)
    assert [bus.emergencies(node) for node in (1, 2)] == [[0x8130]] * 2
    assert [motor.target for motor in bus.robot.motors] == [0.0, 0.0]
    bus.cycles(2.5, ENABLE, 4.0, heartbeat=False)
    assert bus.states == [PowerState.FAULT] * 2
    assert math.degrees(abs(bus.robot.tilt)) == pytest.approx(FLOOR_DEG, abs=0.2)


def test_fault_of_one_motor_opens_its_bridge() -> None:
    bus = Robot(configuration(), faults=parse_faults(["drive_fault:right_wheel@0.5"], ["left_wheel", "right_wheel"]))
    bus.set_up()
    bus.enable()
    bus.cycles(0.2, ENABLE, 2.0)
    assert bus.states == [PowerState.OPERATION_ENABLED, PowerState.FAULT]
    assert not bus.robot.motors[1].powered
    assert bus.robot.yaw < 0.0


def test_control_loop_over_the_bus_balances_the_robot(bus: Robot) -> None:
    """Raised from the bumper with the IMU's frames as decoded by the driver, through the square wave, within 3 deg."""
    imu = Imu(
        ImuConfig(
            protocol=IMU.protocol,
            base_id=IMU.base_id,
            precision=IMU.precision,
            slots=tuple(IMU.slots),
            rate=RATE,
            axes=IMU.axes,
            acceleration_sign=1,
            angular_rate_unit=IMU.angular_rate_unit,
        )
    )
    bus.enable()
    balancer, tilts, volts = Balancer(8.0), [], 0.0
    for _ in range(4 * RATE):
        bus.sent.clear()
        bus.cycle(ENABLE, volts)
        sample = None
        for stamp, can_id, data in bus.sent:
            sample = imu.handle(CanFrame(stamp, can_id, data)) or sample
        assert sample is not None
        volts = max(-12.0, min(12.0, balancer.measured(sample.acceleration, sample.angular_rate)))
        tilts.append(bus.robot.tilt)
    assert math.degrees(tilts[0]) > 11.9
    assert math.degrees(np.abs(tilts[RATE:]).max()) < 3.0


def test_imu_of_the_resting_robot_shows_the_floor_angle(bus: Robot) -> None:
    bus.cycles(0.1, DISABLE_VOLTAGE)
    (x,) = struct.unpack_from("<f", bus.frames(0x18A)[-1])
    assert math.degrees(math.asin(-x)) == pytest.approx(FLOOR_DEG, abs=0.5)


def test_drives_that_do_not_suit_the_robot_are_refused() -> None:
    nodes = wheel_nodes()
    with pytest.raises(SimulationError, match="1 trim drives, a balancing robot has 0"):
        Robot(replace(configuration(), drives=(*nodes, replace(nodes[0], name="trim", role="trim", node=3))))
    with pytest.raises(SimulationError, match=r"6042h \(target_velocity\)"):
        Robot(replace(configuration(), drives=wheel_nodes(mode=2, rpdo=(("controlword", "target_velocity"),))))


def test_plain_canopen_master_runs_the_robot_on_a_python_can_bus(request: pytest.FixtureRequest) -> None:
    channel = request.node.name
    bus = can.Bus(interface="virtual", channel=channel, preserve_timestamps=True)
    other = can.Bus(interface="virtual", channel=channel, preserve_timestamps=True)
    stop = threading.Event()
    runner = Runner(configuration(), bus, lock_step=True, stop=stop)
    thread = threading.Thread(target=runner.run)
    network = canopen.Network(other)
    network.notifier = can.Notifier(other, network.listeners, 0.05)
    thread.start()
    try:
        nodes = [network.add_node(node, str(EDS)) for node in (1, 2)]
        imu_set = threading.Event()
        network.subscribe(0x38A, lambda *_: imu_set.set())
        for node in nodes:
            node.sdo[0x6060].raw = -1
            node.nmt.state = "OPERATIONAL"
        node.rpdo.read()
        assert [variable.index for variable in node.rpdo[1].map] == [0x6040, 0x2400]
        node.tpdo.read()
        assert [variable.index for variable in node.tpdo[1].map] == [0x6041, 0x6064]
        for controlword, cycles, volts in ((0, 15, 0), (6, 15, 0), (7, 15, 0), (15, 15, 0), (15, 20, 3000)):
            for _ in range(cycles):
                assert imu_set.wait(5.0)
                imu_set.clear()
                for node_id, sign in ((1, 1), (2, -1)):
                    network.send_message(0x200 + node_id, struct.pack("<Hh", controlword, sign * volts))
                network.send_message(0x080, b"")
        assert nodes[0].sdo[0x6061].raw == -1
        assert nodes[0].sdo[0x6041].raw & 0x6F == 0x27
        assert nodes[0].sdo[0x2401].raw == pytest.approx(3000, abs=24)
        assert nodes[0].sdo[0x6064].raw > 5
        assert nodes[1].sdo[0x6064].raw < -5
    finally:
        stop.set()
        thread.join(5.0)
        network.disconnect()
        bus.shutdown()
    assert not thread.is_alive()
