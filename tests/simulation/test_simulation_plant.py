"""The virtual vehicle: mechanics and sensors against closed-form solutions, hidden effects against their absence."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from plant_in_the_loop import ClosedLoopRun, Measured, simulate_closed_loop

from upright.drivers.imu.imu import Imu
from upright.drivers.imu.layout import ImuConfig
from upright.simulation.bus.imu_node import VirtualImu
from upright.simulation.config import ImuNode, SimulationConfig
from upright.simulation.monocab.hidden import HIDDEN, MONOCAB
from upright.simulation.monocab.plant import Plant
from upright.simulation.monocab.truth import PlantTruth
from upright.simulation.physics.contact import Supports
from upright.simulation.physics.servo_axis import AxisMode
from upright.simulation.registry import UnknownEffectError, parse_hidden, sizes_of
from upright.telemetry.samples import CanFrame

TRUTH = PlantTruth()
POLE = math.sqrt(TRUTH.gravity_stiffness / TRUTH.inertia)
RATES = (50, 100, 250, 500)


def plant_at(roll: float, config: SimulationConfig | None = None) -> Plant:
    plant = Plant(config or SimulationConfig(PlantTruth()))
    plant.place(roll)
    return plant


def run_for(plant: Plant, seconds: float) -> None:
    plant.advance(round(seconds / plant.step_size))


class Balancer:
    """A small balancing controller for these tests: complementary filter, state feedback, square wave on the roll."""

    def __init__(self, amplitude: float = math.radians(0.7)) -> None:
        self.roll: float | None = None
        self.time = 0.0
        self.amplitude = amplitude

    def __call__(self, measured: Measured) -> tuple[float, float]:
        _, y, z = measured.sample.acceleration
        rate = measured.sample.angular_rate[0]
        tilt = math.atan2(y, z)
        self.roll = tilt if self.roll is None else self.roll + 0.004 * rate + 0.002 * (tilt - self.roll)
        self.time += 0.004
        reference = math.copysign(self.amplitude, math.sin(2.0 * math.pi * 0.5 * self.time))
        setpoint = -(18.0 * (self.roll - reference) + 5.0 * rate) - 4.4 * reference
        return min(1.0, max(-1.0, setpoint)), 0.02 * math.sin(self.time)


@pytest.mark.parametrize("rate", RATES)
def test_step_divides_the_period_and_the_time_of_the_sync(rate: int) -> None:
    """A whole number of steps up to the SYNC at 1 ms and to the next IMU set, at least ten per period."""
    config = SimulationConfig(PlantTruth(), rate=rate)
    assert config.steps_per_period * config.step == pytest.approx(1.0 / rate, rel=1e-12)
    assert config.steps_per_ms * config.step == pytest.approx(1e-3, rel=1e-12)
    assert config.steps_per_period >= 10


def test_fall_has_the_pole_of_gravity_stiffness_over_inertia() -> None:
    """With braked gimbals, roll grows as cosh(pole t); the sine changes that by 1e-5 at these angles."""
    plant = plant_at(1e-4)
    run_for(plant, 1.0)
    assert plant.roll == pytest.approx(1e-4 * math.cosh(POLE * plant.time), rel=2e-5)
    assert pytest.approx(2.964, abs=1e-3) == POLE


def test_time_to_fall_to_the_support_is_that_of_the_linear_model() -> None:
    plant = plant_at(math.radians(1.0))
    while plant.roll < TRUTH.support_angle:
        plant.step()
    # The sine at 4 deg is 0.08 % below its tangent, so the linear model's time is correct to half a percent.
    assert plant.time == pytest.approx(math.acosh(4.0) / POLE, rel=5e-3)


def test_energy_is_conserved_while_flywheels_and_roll_exchange_it() -> None:
    """Free gimbals turn the fall into a fast precession; leapfrog keeps the energy to second order in the step."""
    config = SimulationConfig(plant=replace(TRUTH, gimbal_drag=0.0))
    plant = plant_at(0.02, config)
    for gimbal in plant.gimbals:
        gimbal.axis.mode = AxisMode.COASTING

    def energy() -> float:
        kinetic = 0.5 * TRUTH.inertia * plant.roll_rate**2
        kinetic += sum(0.25 * TRUTH.gimbal_inertia * gimbal.rate**2 for gimbal in plant.gimbals)
        return kinetic + TRUTH.gravity_stiffness * (math.cos(plant.roll) - math.cos(0.02))

    exchanged, worst = 0.0, 0.0
    for _ in range(15_000):
        plant.step()
        exchanged = max(exchanged, 0.5 * TRUTH.inertia * plant.roll_rate**2)
        worst = max(worst, abs(energy()))
    assert abs(plant.roll) < 0.021
    assert exchanged > 0.1
    assert worst < 0.01 * exchanged


def test_soft_speed_loop_increases_the_apparent_inertia() -> None:
    """The paper: I + 8 tau^2 L^2 / I_G. Held at zero speed, the gimbals slow the fall by just that much."""
    plant = plant_at(5e-3)
    for gimbal in plant.gimbals:
        gimbal.axis.power()
    run_for(plant, 0.7)
    growth = math.acosh(plant.roll / 5e-3) / plant.time
    apparent = TRUTH.inertia + 8.0 * TRUTH.gimbal_time_constant**2 * TRUTH.angular_momentum**2 / TRUTH.gimbal_inertia
    assert TRUTH.gravity_stiffness / growth**2 == pytest.approx(apparent, rel=0.03)
    assert apparent > 1.08 * TRUTH.inertia


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_fall_ends_at_rest_on_the_support(side: float) -> None:
    plant = plant_at(side * 1e-3)
    highest = 0.0
    for _ in range(round(6.0 / plant.step_size)):
        plant.step()
        highest = max(highest, abs(plant.roll))
    assert plant.roll == pytest.approx(side * plant.supports.resting_roll(TRUTH.gravity_stiffness), abs=1e-6)
    assert abs(plant.roll_rate) < 1e-6
    assert highest < math.radians(5.0)


def test_vehicle_starts_at_rest_on_the_right_hand_support() -> None:
    plant = Plant(SimulationConfig(PlantTruth()))
    start = plant.roll
    run_for(plant, 1.0)
    assert math.degrees(start) == pytest.approx(4.0, abs=0.05)
    assert plant.roll == pytest.approx(start, abs=1e-9)


@given(st.floats(-0.2, 0.2), st.floats(-5.0, 5.0))
def test_supports_push_and_never_pull(roll: float, roll_rate: float) -> None:
    torque = Supports(TRUTH.support_angle, TRUTH.support_stiffness, TRUTH.support_damping).torque(roll, roll_rate)
    if abs(roll) <= TRUTH.support_angle:
        assert torque == 0.0
    else:
        assert torque * roll <= 0.0


def test_speed_loop_lags_by_four_of_its_time_constants() -> None:
    """Once it has settled, a ramp of the setpoint is followed with the loop's lag of 4 tau."""
    plant = plant_at(0.0, SimulationConfig(plant=replace(TRUTH, angular_momentum=0.0)))
    axis = plant.gimbals[0].axis
    axis.power()
    for _ in range(3000):
        axis.setpoint = 0.2 * plant.time
        plant.step()
    assert plant.time - axis.rate / 0.2 == pytest.approx(4.0 * TRUTH.gimbal_time_constant, rel=0.03)


def test_torque_limit_holds_without_integrator_windup() -> None:
    plant = plant_at(0.0, SimulationConfig(plant=replace(TRUTH, angular_momentum=0.0, gimbal_torque_limit=100.0)))
    axis = plant.gimbals[0].axis
    axis.power()
    axis.setpoint = 1.0
    highest = 0.0
    for _ in range(3000):
        plant.step()
        assert abs(axis.torque) <= 100.0
        highest = max(highest, axis.rate)
    assert axis.rate == pytest.approx(1.0, abs=0.01)
    assert highest < 1.15


def test_braked_gimbal_withstands_the_gyroscopic_reaction() -> None:
    plant = plant_at(0.01)
    run_for(plant, 1.5)
    assert plant.precession == pytest.approx(0.0, abs=1e-9)


def test_trim_mass_on_the_right_rolls_right_and_its_acceleration_rolls_left() -> None:
    plant = plant_at(0.0)
    plant.trim.position = 0.05
    plant.step()
    moment = TRUTH.trim_mass * 9.81 * 0.05
    assert plant.roll_acceleration == pytest.approx(moment / (TRUTH.inertia + TRUTH.trim_mass * 0.05**2), rel=1e-3)
    plant = plant_at(0.0)
    plant.trim.power()
    plant.trim.setpoint = 0.1
    run_for(plant, 0.02)
    assert plant.trim.rate > 0.0
    assert plant.roll_acceleration < 0.0


def test_side_load_requires_a_precession_of_torque_over_angular_momentum() -> None:
    """Held upright, 550 N m require a precession rate of 550 / 3300 rad/s: the plant obeys the torque balance."""
    config = SimulationConfig(PlantTruth(), hidden={"torque_step": None}, onsets={"torque_step": 1.0})
    run = simulate_closed_loop(config, Balancer(amplitude=0.0), 6.0, roll=0.0)
    tail = run.precession_rate[-250:]
    lean = run.true_roll[-250:].mean()
    expected = -(550.0 + TRUTH.gravity_stiffness * lean + TRUTH.trim_mass * 9.81 * run.trim_position[-250:].mean())
    assert tail.mean() == pytest.approx(expected / TRUTH.angular_momentum, rel=0.03)


def balanced(hidden: dict[str, float | None], seed: int = 1) -> ClosedLoopRun:
    config = SimulationConfig(PlantTruth(), hidden=hidden, seed=seed, onsets={"torque_step": 1.0})
    return simulate_closed_loop(config, Balancer(), 3.0, roll=0.0)


@pytest.fixture(scope="module")
def bare() -> ClosedLoopRun:
    return balanced({})


def test_level_zero_equals_no_hidden_effects(bare: ClosedLoopRun) -> None:
    again = balanced(dict.fromkeys(HIDDEN, 0.0))
    assert np.array_equal(again.true_roll, bare.true_roll)
    assert np.array_equal(again.angular_rate, bare.angular_rate)
    assert np.abs(bare.true_roll).max() < math.radians(2.0)


@pytest.mark.parametrize("name", HIDDEN)
def test_each_hidden_effect_changes_the_motion_and_keeps_the_balance(name: str, bare: ClosedLoopRun) -> None:
    """By more than a noise-free digit of the sensor (1e-5 rad), with the same noise; twice the level changes more."""
    once, twice = balanced({name: None}), balanced({name: 2.0})
    change = float(np.abs(once.true_roll - bare.true_roll).max())
    assert change > 1e-5
    assert float(np.abs(twice.true_roll - bare.true_roll).max()) > 1.1 * change
    assert float(np.abs(once.true_roll).max()) < math.radians(3.5)


def test_gimbal_turns_only_after_the_motor_has_crossed_the_backlash() -> None:
    plant = plant_at(0.0, SimulationConfig(hidden={"backlash": None}, plant=replace(TRUTH, angular_momentum=0.0)))
    gimbal = plant.gimbals[0]
    gimbal.axis.power()
    gimbal.axis.setpoint = 0.05
    while gimbal.axis.position < 0.5 * HIDDEN["backlash"].size:
        assert gimbal.angle == 0.0
        plant.step()
    run_for(plant, 0.5)
    assert gimbal.angle > 0.02


def test_dry_friction_holds_against_less_than_its_breakaway_torque() -> None:
    """40 N m move an upright vehicle; with 60 N m of dry friction it stays within the deflection of the bristles."""
    loose = plant_at(0.0, SimulationConfig(PlantTruth(), hidden={"static_torque": 1.0 / 3.0}))
    stuck = plant_at(0.0, SimulationConfig(PlantTruth(), hidden={"static_torque": 1.0 / 3.0, "coulomb_friction": None}))
    for plant in (loose, stuck):
        run_for(plant, 0.5)
    assert loose.roll > 2e-3
    assert stuck.roll < 3e-4


def test_unknown_effect_error_lists_the_available_effects() -> None:
    with pytest.raises(UnknownEffectError, match="coulomb_friction") as caught:
        SimulationConfig(PlantTruth(), hidden={}) and parse_hidden(["friction"], MONOCAB)
    assert caught.value.name == "friction"
    with pytest.raises(UnknownEffectError, match="static_torque"):
        Plant(SimulationConfig(PlantTruth(), hidden={"no_such": None}))


def test_levels_scale_the_default_amplitude() -> None:
    assert sizes_of(parse_hidden(["static_torque=2", "input_delay"], MONOCAB)[0], MONOCAB) == {
        "static_torque": 240.0,
        "input_delay": 0.012,
    }
    with pytest.raises(UnknownEffectError, match="Give numbers"):
        parse_hidden(["static_torque=big"], MONOCAB)


@pytest.mark.parametrize(
    "argument", ["input_delay=-1", "actuator_lag=-0.5", "flexible_mode=9", "backlash=nan", "static_torque=inf"]
)
def test_level_out_of_range_is_refused_with_the_range(argument: str) -> None:
    with pytest.raises(UnknownEffectError, match="Use a level from"):
        parse_hidden([argument], MONOCAB)
    assert sizes_of({"static_torque": -1.0}, MONOCAB) == {"static_torque": -120.0}


def test_effect_changes_nothing_before_its_onset() -> None:
    """Until then, the motion is bit-identical; after it, friction shows within a second."""
    hidden, onsets = parse_hidden(["viscous_friction=2@1.5"], MONOCAB)
    late = simulate_closed_loop(SimulationConfig(PlantTruth(), hidden=hidden, onsets=onsets), Balancer(), 3.0, roll=0.0)
    never = simulate_closed_loop(SimulationConfig(PlantTruth()), Balancer(), 3.0, roll=0.0)
    changed = np.flatnonzero(late.true_roll != never.true_roll)
    begin = changed[0] * 3.0 / len(late.true_roll)
    assert 1.4 < begin < 1.6
    assert np.abs(late.true_roll - never.true_roll)[-1] > 1e-5


@pytest.mark.parametrize(
    ("argument", "match"),
    [("sensor_lag=1@5", "from the beginning"), ("viscous_friction@-1", "0 or more"), ("viscous_friction@x", "numbers")],
)
def test_invalid_onset_is_refused(argument: str, match: str) -> None:
    with pytest.raises(UnknownEffectError, match=match):
        parse_hidden([argument], MONOCAB)


def resting_samples(imu: ImuNode, rate: int = 250, count: int = 20_000) -> tuple[np.ndarray, np.ndarray]:
    config = SimulationConfig(PlantTruth(), imu=imu, rate=rate)
    plant = plant_at(0.0, config)
    device = VirtualImu(imu, rate=rate, seed=3, gravity=9.81, sizes={})
    samples = [device.measure(plant) for _ in range(count)]
    return np.array([s[0] for s in samples]), np.array([s[1] for s in samples])


@pytest.mark.parametrize("rate", [100, 500])
def test_sensor_noise_has_the_data_sheets_standard_deviation(rate: int) -> None:
    """20,000 samples: the standard deviation of a standard deviation is 0.5 %, so 2 % is four of them."""
    node = ImuNode(bias_random_walk=0.0)
    acceleration, angular_rate = resting_samples(node, rate)
    assert acceleration.std(axis=0) == pytest.approx([0.015] * 3, rel=0.02)
    assert angular_rate.std(axis=0) == pytest.approx([3.5e-5 * math.sqrt(rate / 2.0)] * 3, rel=0.02)
    assert angular_rate.mean(axis=0) == pytest.approx(node.angular_rate_bias, abs=2e-5)
    assert acceleration.mean(axis=0) == pytest.approx([0.0, 0.0, 9.81], abs=5e-4)


def test_gyro_bias_is_a_slow_random_walk() -> None:
    """2e-6 rad/s/sqrt(s) over 80 s: a standard deviation of 1.8e-5 rad/s; the walk stays below five of these."""
    _, angular_rate = resting_samples(ImuNode(angular_rate_density=0.0))
    travel = angular_rate - angular_rate[0]
    assert 0.0 < np.abs(travel).max() < 5.0 * 2e-6 * math.sqrt(80.0)


def test_int16_readings_are_multiples_of_the_resolution() -> None:
    acceleration, angular_rate = resting_samples(ImuNode(precision="int16"), count=500)
    steps = angular_rate / math.radians(0.1)
    assert steps == pytest.approx(np.round(steps), abs=1e-9)
    steps = acceleration / 9.80665e-3
    assert steps == pytest.approx(np.round(steps), abs=1e-9)


def test_accelerometer_measures_gravity_and_the_acceleration_of_its_lever_arm() -> None:
    node = ImuNode(acceleration_std=0.0, position=(0.0, 0.2, 0.9))
    plant = plant_at(0.03)
    plant.roll_rate, plant.roll_acceleration = 0.5, 2.0
    device = VirtualImu(node, rate=250, seed=1, gravity=9.81, sizes={})
    acceleration, angular_rate = device.measure(plant)
    assert acceleration[0] == 0.0
    assert acceleration[1] == pytest.approx(9.81 * math.sin(0.03) - 2.0 * 0.9 - 0.25 * 0.2)
    assert acceleration[2] == pytest.approx(9.81 * math.cos(0.03) + 2.0 * 0.2 - 0.25 * 0.9)
    assert angular_rate[0] == pytest.approx(0.5 + 8.7e-4, abs=3e-3)


def delayed(sizes: dict[str, float], signal: Callable[[float], float]) -> list[float]:
    node = ImuNode(angular_rate_density=0.0, bias_random_walk=0.0, angular_rate_bias=(0.0, 0.0, 0.0))
    device = VirtualImu(node, rate=250, seed=1, gravity=9.81, sizes=sizes)
    plant = plant_at(0.0)
    seen = []
    for sample in range(100):
        plant.roll_rate = signal(sample * 0.004)
        seen.append(device.measure(plant)[1][0])
    return seen


def test_hidden_sensor_delay_and_lag_shift_a_ramp() -> None:
    """A ramp of the rate is late by exactly the delay, or by the lag's time constant (and half a sample)."""
    late = delayed({"sensor_delay": 0.010}, lambda time: time)
    assert late[50] == pytest.approx(0.2 - 0.010, abs=1e-12)
    lagged = delayed({"sensor_lag": 0.020}, lambda time: time)
    assert lagged[-1] == pytest.approx(99 * 0.004 - 0.020, abs=0.0021)


MOUNTINGS = [
    ImuNode(),
    ImuNode(protocol="sequential", base_id=0x514, axes=("-y", "+x", "+z"), acceleration_sign=-1),
    ImuNode(precision="int16", axes=("+z", "+y", "-x")),
    ImuNode(
        protocol="sequential",
        base_id=0x515,
        angular_rate_unit="rad/s",
        slots=(
            "off",
            "angular_rate_z",
            "angular_rate_y",
            "angular_rate_x",
            "temperature",
            "acceleration_z",
            "acceleration_x",
            "acceleration_y",
            "euler_x",
        ),
    ),
]


@pytest.mark.parametrize("node", MOUNTINGS)
def test_imu_driver_decodes_what_the_virtual_imu_measured(node: ImuNode) -> None:
    """Both are written independently from the vendor's table and must agree on every layout and mounting."""
    reader = Imu(
        ImuConfig(
            protocol=node.protocol,
            base_id=node.base_id,
            precision=node.precision,
            slots=tuple(node.slots),
            rate=250,
            axes=node.axes,
            acceleration_sign=-1 if node.acceleration_sign < 0 else 1,
            angular_rate_unit=node.angular_rate_unit,
        )
    )
    device = VirtualImu(node, rate=250, seed=5, gravity=9.81, sizes={})
    plant = plant_at(0.06)
    plant.roll_rate = 0.3
    acceleration, angular_rate = device.measure(plant)
    sample = None
    for place, data in enumerate(device.encode(acceleration, angular_rate)):
        sample = reader.handle(CanFrame(1_000_000_000, device.can_id(place), data))
    assert sample is not None
    assert sample.acceleration == pytest.approx(acceleration, abs=1e-5)
    assert sample.angular_rate == pytest.approx(angular_rate, abs=1e-6)
