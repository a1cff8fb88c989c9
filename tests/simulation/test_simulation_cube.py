"""The virtual cube on its edge: its motion compared with energies and closed-form solutions; its drive on the bus."""

from __future__ import annotations

import math
import struct
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from simulated_bus import DISABLE_VOLTAGE, MASTER, QUICK_STOP, SHUTDOWN, SWITCH_ON, Harness

from upright.simulation.bus.power_state import PowerState
from upright.simulation.config import DriveNode, ImuNode, SimulationConfig
from upright.simulation.cube.hidden import AT_THE_WHEEL, CUBE, CUBE_HIDDEN, CUBE_UNLISTED
from upright.simulation.cube.plant import CubePlant
from upright.simulation.cube.truth import CubeTruth
from upright.simulation.kinds import machine
from upright.simulation.registry import parse_hidden

EDS = Path(__file__).resolve().parents[2] / "drivers" / "eds" / "upright_torque.eds"
RATE = 250
TRUTH = CubeTruth()
IMU = ImuNode(position=(0.0, 0.0, 0.08))
LOSSLESS = replace(TRUTH, edge_friction=0.0, wheel_friction=0.0, support_angle=100.0, torque_noise=0.0)
"""Without friction, torque noise and supports."""
EVERY = (*CUBE_HIDDEN, *CUBE_UNLISTED)
ENABLE = 0x0F
RATED = 0.083


def cube(truth: CubeTruth = TRUTH, hide: Sequence[str] = ()) -> CubePlant:
    hidden, onsets = parse_hidden(hide, CUBE)
    made = machine(SimulationConfig(plant=truth, rate=RATE, imu=IMU, hidden=hidden, onsets=onsets))
    assert isinstance(made, CubePlant)
    return made


def run_for(plant: CubePlant, seconds: float) -> None:
    plant.advance(round(seconds / plant.step_size))


def energy(plant: CubePlant, truth: CubeTruth) -> float:
    """J, by the paper's table I: the body and the wheel's mass about the edge, the wheel by its own rate in space."""
    body = truth.body_inertia + truth.wheel_mass * truth.wheel_height**2
    heights = truth.body_mass * truth.body_height + truth.wheel_mass * truth.wheel_height
    spun = plant.tilt_rate + plant.wheel_rate
    kinetic = 0.5 * body * plant.tilt_rate**2 + 0.5 * truth.wheel_inertia * spun**2
    return kinetic + truth.gravity * heights * math.cos(plant.tilt)


def test_energy_is_conserved_without_friction_and_torque() -> None:
    plant = cube(LOSSLESS)
    plant.place(0.3)
    begin, tallest = energy(plant, LOSSLESS), 0.0
    for _ in range(40):
        run_for(plant, 0.1)
        tallest = max(tallest, abs(plant.tilt))
        assert energy(plant, LOSSLESS) == pytest.approx(begin, abs=1e-4)
    assert tallest > 3.0, "it swings through below its edge"


def test_upright_is_unstable_with_the_pole_of_the_pendulum() -> None:
    plant, begin = cube(LOSSLESS), 1e-4
    plant.place(begin)
    run_for(plant, 0.4)
    pole = math.sqrt(LOSSLESS.gravity_stiffness / LOSSLESS.inertia)
    assert plant.tilt == pytest.approx(begin * math.cosh(0.4 * pole), rel=1e-3)
    assert pole == pytest.approx(9.7, rel=0.02)


def test_wheel_torque_transfers_momentum_between_body_and_wheel() -> None:
    """A torque between the two does not change their total momentum: only gravity does, which is small near upright."""
    plant = cube(LOSSLESS)
    plant.place(0.0)
    plant.wheel.powered, plant.wheel.target = True, 0.05
    run_for(plant, 0.02)
    body = LOSSLESS.inertia * plant.tilt_rate
    wheel = LOSSLESS.wheel_inertia * (plant.tilt_rate + plant.wheel_rate)
    lagging = LOSSLESS.torque_lag + 0.5 * plant.step_size
    assert wheel == pytest.approx(0.05 * (0.02 - lagging), rel=0.02)
    assert body == pytest.approx(-wheel, rel=0.02)
    assert plant.tilt < 0.0 < plant.wheel_angle


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_released_cube_falls_and_rests_on_a_support(side: float) -> None:
    plant = cube()
    plant.place(side * 0.01)
    run_for(plant, 2.0)
    assert math.copysign(1.0, plant.tilt) == side
    assert abs(plant.tilt) == pytest.approx(TRUTH.support_angle, abs=2e-3)
    assert abs(plant.tilt_rate) < 1e-3


def test_cube_starts_at_rest_on_its_front_support() -> None:
    plant = cube()
    begin = plant.tilt
    run_for(plant, 1.0)
    assert plant.tilt == pytest.approx(begin, abs=1e-6)
    assert begin > TRUTH.support_angle
    assert plant.wheel_rate == pytest.approx(0.0, abs=1e-3)


def moved(hide: Sequence[str]) -> np.ndarray:
    """Tilt, tilt rate and wheel rate over 12 s while a wheel torque shakes the cube on its support, (n, 3)."""
    plant = cube(hide=hide)
    plant.event_origin = 0.0
    plant.wheel.powered = True
    rows = []
    for step in range(3000):
        plant.wheel.target = 0.03 * math.sin(2.0 * math.pi * 1.5 * step / RATE)
        run_for(plant, 1.0 / RATE)
        rows.append((plant.tilt, plant.tilt_rate, plant.wheel_rate))
    return np.array(rows)


@pytest.fixture(scope="module")
def bare() -> np.ndarray:
    return moved(())


IN_THE_IMU = {"gyro_bias", "sensor_offset", "sensor_lag", "sensor_delay", "sensor_scale"}


@pytest.mark.parametrize("name", [each for each in EVERY if each not in IN_THE_IMU])
def test_each_hidden_effect_changes_the_motion(name: str, bare: np.ndarray) -> None:
    found = moved((name,))
    assert np.isfinite(found).all()
    assert not np.array_equal(found, bare)
    assert np.array_equal(moved((f"{name}=0",)), bare)


def test_listed_effects_are_in_the_catalogue_and_unlisted_ones_are_not() -> None:
    from upright.models.effects.catalogue import CATALOGUE

    assert {name for name in CUBE_HIDDEN if name.startswith("wheel_")} == set(AT_THE_WHEEL)
    assert {name.partition("@")[0] for name in AT_THE_WHEEL.values()} <= set(CATALOGUE)
    assert {name for name in CUBE_HIDDEN if name not in AT_THE_WHEEL} <= set(CATALOGUE)
    assert not set(CUBE_UNLISTED) & set(CATALOGUE)


def test_wheel_friction_reacts_on_the_body() -> None:
    plant = cube(LOSSLESS, ["wheel_viscous_friction=5"])
    plant.place(0.0)
    plant.wheel_rate = 50.0
    begin = LOSSLESS.wheel_inertia * 50.0
    run_for(plant, 0.02)
    wheel = LOSSLESS.wheel_inertia * (plant.tilt_rate + plant.wheel_rate)
    assert wheel - begin == pytest.approx(-5e-4 * 50.0 * 0.02, rel=0.05)
    assert LOSSLESS.inertia * plant.tilt_rate == pytest.approx(begin - wheel, rel=0.05)


def test_accelerometer_measures_gravity_and_the_acceleration_of_its_position() -> None:
    plant = cube()
    (x, y, z), rates = plant.felt((0.1, 0.5, 3.0), (0.02, 0.0, 0.08), 9.81)
    # Specific force in body axes, at (0.02, 0.08) on a body with a tilt of 0.1 rad, 0.5 rad/s, 3 rad/s^2.
    assert (x, y, z) == pytest.approx(
        (3.0 * 0.08 - 0.25 * 0.02 - 9.81 * math.sin(0.1), 0.0, 9.81 * math.cos(0.1) - 3.0 * 0.02 - 0.25 * 0.08)
    )
    assert rates == (0.0, 0.5, 0.0)


# --- on the bus


def node(**changes: object) -> DriveNode:
    wheel = DriveNode(
        name="wheel",
        role="wheel",
        node=1,
        direction=1,
        axis_per_turn=2.0 * math.pi,
        increments_per_turn=8192,
        velocity_unit_rpm=1.0 / 8192.0,
        rated_torque=RATED,
        eds=EDS,
        mode=10,
        rpdo=(("controlword", "target_torque"),),
        tpdo=(("statusword", "position_actual"), ("velocity_actual", "torque_actual")),
    )
    return replace(wheel, **changes)  # type: ignore[arg-type]


class Bus(Harness):
    """The master of the other tests, with N m instead of rpm and with one node."""

    def __init__(self, **changes: object) -> None:
        super().__init__(SimulationConfig(plant=TRUTH, drives=(node(**changes),), rate=RATE, imu=IMU))
        assert self.sdo(1, 0x6060, 0, 10, 1) >= 0
        assert self.sdo(1, 0x1016, 1, MASTER << 16 | 120) >= 0
        assert self.sdo(1, 0x6007, 0, 2, 2) >= 0
        self.nmt(1)

    def cycle(self, controlword: int, torque: float = 0.0, *, heartbeat: bool = True, rpdo: bool = True) -> None:
        if rpdo:
            self.vehicle.receive(0x201, struct.pack("<Hh", controlword, round(torque / RATED * 1000.0)))
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
    def cube(self) -> CubePlant:
        assert isinstance(self.vehicle.plant, CubePlant)
        return self.vehicle.plant

    @property
    def state(self) -> PowerState:
        return self.vehicle.drives["wheel"].state

    def actual(self) -> tuple[int, int, int, int]:
        """Statusword, position, velocity and torque as last sent by the drive."""
        word, position = struct.unpack("<Hi", self.frames(0x181)[-1])
        return word, position, *struct.unpack("<ih", self.frames(0x281)[-1])


def test_master_enables_the_drive_in_torque_mode() -> None:
    bus = Bus()
    bus.enable()
    assert bus.state is PowerState.OPERATION_ENABLED
    assert bus.sdo(1, 0x6061) & 0xFF == 10
    assert bus.sdo(1, 0x6502) == 1 << 9
    assert bus.sdo(1, 0x6060, 0, 9, 1) == -0x06090030, "it has no velocity mode"


@pytest.mark.parametrize("direction", [1, -1])
def test_target_torque_turns_the_wheel_in_the_drives_direction(direction: int) -> None:
    bus = Bus(direction=direction)
    bus.enable()
    bus.cycles(0.2, ENABLE, 0.02)
    word, position, velocity, torque = bus.actual()
    assert word & 0x1800 == 0x1000, "it follows, within its limit"
    assert torque == bus.sdo(1, 0x6074) == 241
    assert position > 0
    assert velocity > 0
    assert math.copysign(1.0, bus.cube.wheel_rate) == direction
    assert velocity / 8192.0 * 2.0 * math.pi / 60.0 == pytest.approx(abs(bus.cube.wheel_rate), abs=1.0)


def test_torque_beyond_the_current_limit_is_limited_and_reported() -> None:
    bus = Bus()
    bus.enable()
    bus.cycles(0.02, ENABLE, 0.2)
    assert bus.actual()[0] & 0x800
    assert bus.sdo(1, 0x6074) == round(TRUTH.torque_limit / RATED * 1000.0)
    assert bus.cube.wheel.torque == pytest.approx(TRUTH.torque_limit, abs=5.0 * TRUTH.torque_noise)


@pytest.mark.parametrize("controlword", [ENABLE | 0x100, SWITCH_ON])
def test_halt_and_disable_remove_the_torque(controlword: int) -> None:
    bus = Bus()
    bus.enable()
    bus.cycles(0.05, ENABLE, 0.02)
    bus.cycles(0.05, controlword, 0.02)
    assert bus.cube.wheel.target == 0.0


def test_after_a_quick_stop_the_wheel_coasts_and_the_cube_stays_on_its_support() -> None:
    """Braking would throw the cube over, so object 605Ah is 0."""
    bus = Bus()
    bus.enable()
    bus.cycles(0.3, ENABLE, 0.03)
    spinning = bus.cube.wheel_rate
    assert spinning > 10.0
    bus.cycles(0.2, QUICK_STOP)
    assert not bus.cube.wheel.powered
    assert bus.cube.wheel_rate == pytest.approx(spinning, rel=0.05)
    assert bus.cube.tilt == pytest.approx(TRUTH.support_angle, abs=3e-3)


def test_drive_with_a_braking_quick_stop_stops_the_wheel() -> None:
    bus = Bus()
    assert bus.sdo(1, 0x605A, 0, 2, 2) >= 0
    bus.enable()
    bus.cycles(0.1, ENABLE, 0.03)
    bus.cycles(0.5, QUICK_STOP)
    assert abs(bus.cube.wheel_rate) < 1.0


def test_loss_of_the_masters_heartbeat_removes_the_torque() -> None:
    bus = Bus()
    bus.enable()
    bus.cycles(0.135, ENABLE, 0.02, heartbeat=False)
    assert bus.emergencies(1) == [0x8130]
    assert not bus.cube.wheel.powered
