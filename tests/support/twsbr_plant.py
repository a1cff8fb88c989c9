"""The virtual balancing robot without a bus, and a controller that holds it, for the tests of its physics."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from upright.simulation.config import ImuNode, SimulationConfig
from upright.simulation.kinds import machine
from upright.simulation.registry import parse_hidden
from upright.simulation.twsbr.hidden import TWSBR
from upright.simulation.twsbr.plant import TwsbrPlant
from upright.simulation.twsbr.truth import TwsbrTruth

RATE = 200
TRUTH = TwsbrTruth()
LOSSLESS = replace(TRUTH, motor_friction=0.0, wheel_friction=0.0, floor_angle=100.0)
"""Without friction, and without a floor, so that the body can hang."""
PITCH = 2.0 * math.pi / TRUTH.encoder_counts_per_turn
IMU = ImuNode(position=(0.01, 0.0, 0.06))


def robot(truth: TwsbrTruth = TRUTH, hide: Sequence[str] = (), **options: object) -> TwsbrPlant:
    hidden, onsets = parse_hidden(hide, TWSBR)
    config = SimulationConfig(plant=truth, rate=RATE, imu=IMU, hidden=hidden, onsets=onsets, **options)  # type: ignore[arg-type]
    return machine(config)


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


def run_for(plant: TwsbrPlant, seconds: float) -> None:
    plant.advance(round(seconds / plant.step_size))


def drive(plant: TwsbrPlant, left: float, right: float | None = None) -> None:
    for motor, volts in zip(plant.motors, (left, left if right is None else right), strict=True):
        motor.powered, motor.target = True, volts


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
