"""The virtual vehicle in closed loop with a controller function, without a bus, for statistics over many seeds.

Same mechanics, sensors and timing as on the bus: the setpoint computed from the sample of t_k acts from t_k + 1 ms, and
the drive values that the controller gets were measured one cycle earlier, at t_k-1 + 1 ms.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from upright.simulation.bus.imu_node import VirtualImu
from upright.simulation.config import SimulationConfig
from upright.simulation.monocab.plant import Plant
from upright.simulation.vehicle import START_NS
from upright.telemetry.samples import ImuSample

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Measured:
    """Inputs of a controller: the IMU's sample and the drives' values of `drive_timestamp_ns`; axis units."""

    sample: ImuSample
    drive_timestamp_ns: int
    precession: float
    precession_rate: float
    trim_position: float
    trim_rate: float


Controller = Callable[[Measured], tuple[float, float]]
"""Measured values to setpoints of precession rate (rad/s) and trim rate (m/s)."""


@dataclass(frozen=True, slots=True)
class ClosedLoopRun:
    """One row per control cycle, n rows: measured values, commanded values, and true values."""

    timestamp_ns: NDArray[np.int64]
    """(n,) of the IMU samples."""
    drive_timestamp_ns: NDArray[np.int64]
    """(n,) of the drive values."""
    acceleration: Array
    """(n, 3), m/s^2."""
    angular_rate: Array
    """(n, 3), rad/s."""
    precession: Array
    precession_rate: Array
    precession_rate_setpoint: Array
    trim_position: Array
    trim_rate: Array
    trim_rate_setpoint: Array
    true_roll: Array
    true_roll_rate: Array


def simulate_closed_loop(
    config: SimulationConfig, controller: Controller, duration: float, *, roll: float | None = None
) -> ClosedLoopRun:
    """Run `duration` s with drives enabled, from rest on the support or from `roll` (rad). Event times start here."""
    plant = Plant(config)
    plant.event_origin = 0.0
    if roll is not None:
        plant.place(roll)
    gravity = config.plant.gravity
    imu = VirtualImu(config.imu, rate=config.rate, seed=config.seed, gravity=gravity, sizes=config.sizes)
    gimbals = [gimbal.axis for gimbal in plant.gimbals]
    trim = plant.trim
    for axis in (*gimbals, trim):
        axis.power()
    drive_ns, drive_values = START_NS, (0.0, 0.0, 0.0, 0.0)
    times: list[tuple[int, int]] = []
    rows: list[tuple[float, ...]] = []
    for cycle in range(round(duration * config.rate)):
        now_ns = START_NS + cycle * config.period_ns
        acceleration, angular_rate = imu.measure(plant)
        measured = Measured(ImuSample(now_ns, acceleration, angular_rate), drive_ns, *drive_values)
        setpoint, trim_setpoint = controller(measured)
        times.append((now_ns, drive_ns))
        truth = (plant.roll, plant.roll_rate)
        rows.append((*acceleration, *angular_rate, *drive_values, setpoint, trim_setpoint, *truth))
        plant.advance(config.steps_per_ms)
        for axis in gimbals:
            axis.setpoint = setpoint
        trim.setpoint = trim_setpoint
        drive_ns = now_ns + 1_000_000
        drive_values = (
            sum(axis.measured_position for axis in gimbals) / 2.0,
            sum(axis.measured_rate for axis in gimbals) / 2.0,
            trim.measured_position,
            trim.measured_rate,
        )
        plant.advance(config.steps_per_period - config.steps_per_ms)
    return _as_run(times, rows)


def _as_run(times: list[tuple[int, int]], rows: list[tuple[float, ...]]) -> ClosedLoopRun:
    stamps = np.array(times, dtype=np.int64).reshape(-1, 2)
    values = np.array(rows, dtype=np.float64).reshape(-1, 14)
    return ClosedLoopRun(
        timestamp_ns=stamps[:, 0],
        drive_timestamp_ns=stamps[:, 1],
        acceleration=values[:, 0:3],
        angular_rate=values[:, 3:6],
        precession=values[:, 6],
        precession_rate=values[:, 7],
        precession_rate_setpoint=values[:, 10],
        trim_position=values[:, 8],
        trim_rate=values[:, 9],
        trim_rate_setpoint=values[:, 11],
        true_roll=values[:, 12],
        true_roll_rate=values[:, 13],
    )
