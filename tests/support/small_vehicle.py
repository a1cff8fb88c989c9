"""A small independent closed loop to test the estimators with: many noisy vehicles at once, one column per seed.

Nonlinear roll, gimbals with a first-order speed loop, gyro and accelerometer noise, quantised precession rate, drive
values one control cycle old. It uses nothing from models/ or simulation/.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from monocab_channels import MONOCAB
from numpy.typing import NDArray

from upright.telemetry.recording import Recording
from upright.telemetry.samples import Frame

Array = NDArray[np.float64]

CHANNELS = (
    "roll",
    "roll_rate",
    "precession",
    "precession_rate",
    "precession_rate_setpoint",
    "drive_age",
    "roll_reference",
    "excitation",
)


@dataclass(frozen=True)
class Truth:
    inertia: float = 1650.0
    gravity_stiffness: float = 14500.0
    static_torque: float = 40.0
    angular_momentum: float = 3300.0
    speed_loop_lag: float = 0.04
    gyro_density: float = 3.5e-5  # rad/s/sqrt(Hz)
    accelerometer_roll_std: float = 0.003  # rad, per sample
    coulomb_friction: float = 0.0  # N m

    def acceleration(self, roll: Array, rate: Array, precession_rate: Array) -> Array:
        torque = self.gravity_stiffness * np.sin(roll) + self.angular_momentum * precession_rate + self.static_torque
        return (torque - self.coulomb_friction * np.tanh(rate / 1e-3)) / self.inertia


def sweep(time: float, span: float = 60.0) -> float:
    """Logarithmic sine sweep on the roll reference, 0.6 deg from 0.05 to 3 Hz, ramped in and out over a second."""
    amplitude, start, stop = np.radians(0.6), 0.05, 3.0
    if time > span:
        return 0.0
    rate = np.log(stop / start) / span
    ramp = min(1.0, time, span - time)
    return float(amplitude * ramp * np.sin(2 * np.pi * start * np.expm1(rate * time) / rate))


def run(
    seeds: int,
    duration: float,
    truth: Truth = Truth(),
    *,
    reference: Callable[[float], float] = lambda time: 0.0,
    from_support: bool = False,
    spacing: float = 0.004,
    jitter: float = 0.0,
    first_seed: int = 0,
) -> tuple[NDArray[np.int64], dict[str, Array]]:
    """Time stamps (n,) in ns and channels (n, seeds). From the support, the paper's step first brings it upright."""
    random = np.random.default_rng(first_seed)
    substeps = 4
    gains = np.array([21.0, 7.0, 0.35])  # roll, roll rate, precession rate: places the poles at 3 to 8 1/s
    integral_gain = 12.0
    support = np.radians(4.0)
    roll = np.full(seeds, support if from_support else 0.0)
    rate, precession, speed = np.zeros(seeds), np.zeros(seeds), np.zeros(seeds)
    setpoint, integral = np.zeros(seeds), np.zeros(seeds)
    roll_estimate = roll.copy()
    last_gyro = np.zeros(seeds)
    resting, righting = np.full(seeds, from_support), np.full(seeds, from_support)
    gyro_std = truth.gyro_density / np.sqrt(2 * spacing)
    unit = 2 * np.pi / 60 / 8192 / 100
    steps = round(duration / spacing)
    table = {name: np.zeros((steps, seeds)) for name in CHANNELS}
    stamps = np.zeros(steps, dtype=np.int64)
    drive, drive_precession, drive_time = np.zeros(seeds), np.zeros(seeds), -spacing
    time = 0.0
    for k in range(steps):
        gyro = rate + gyro_std * random.standard_normal(seeds)
        tilt = roll + truth.accelerometer_roll_std * random.standard_normal(seeds)
        if k:
            roll_estimate += spacing * 0.5 * (gyro + last_gyro)
            roll_estimate += spacing * 0.93 * (tilt - roll_estimate)
        last_gyro = gyro
        target = reference(time)
        push = np.where(righting, -0.42, 0.0) if from_support else np.zeros(seeds)
        if time < 1.0:
            push = np.zeros(seeds)
        righting &= roll_estimate > np.radians(0.2)
        error = roll_estimate - target
        integral = np.where(resting | righting, 0.0, integral + spacing * error)
        control = -(gains[0] * error + gains[1] * gyro + gains[2] * drive + integral_gain * integral)
        setpoint = np.where(resting | righting, push, np.clip(control, -1.0, 1.0))
        for name, value in (
            ("roll", roll_estimate),
            ("roll_rate", gyro),
            ("precession", drive_precession),
            ("precession_rate", drive),
            ("precession_rate_setpoint", setpoint),
            ("drive_age", time - drive_time),
            ("roll_reference", target),
            ("excitation", push if from_support else target),
        ):
            table[name][k] = value
        stamps[k] = round((1000.0 + time) * 1e9)
        # Drives latch at SYNC, 0.3 ms after the IMU sample, and answer with the values measured then.
        length = spacing + jitter * random.standard_normal()
        sync = 0.0003
        for part, dt in ((0, sync), *((i, (length - sync) / substeps) for i in range(1, substeps + 1))):
            speed_change = (setpoint - speed) / truth.speed_loop_lag
            middle = speed + 0.5 * dt * speed_change
            acc = truth.acceleration(roll + 0.5 * dt * rate, rate, middle)
            resting &= truth.acceleration(roll, rate, speed) >= 0.0
            roll = roll + np.where(resting, 0.0, dt * rate + 0.5 * dt * dt * acc)
            rate = np.where(resting, 0.0, rate + dt * acc)
            precession = precession + dt * middle
            speed = speed + dt * speed_change * (1 - 0.5 * dt / truth.speed_loop_lag)
            if part == 0:
                drive, drive_precession, drive_time = np.round(speed / unit) * unit, precession.copy(), time + sync
        time += length
    return stamps, table


def frames(stamps: NDArray[np.int64], table: dict[str, Array], seed: int) -> Iterator[Frame]:
    """The control cycles of one seed; channels the small vehicle does not have are 0."""
    rows = np.zeros((len(stamps), len(MONOCAB)))
    for name, column in table.items():
        rows[:, MONOCAB.index_of(name)] = column[:, seed]
    for stamp, row in zip(stamps.tolist(), rows.tolist(), strict=True):
        yield Frame(stamp, tuple(row))


def recording(stamps: NDArray[np.int64], table: dict[str, Array], seed: int) -> Recording:
    """The control cycles of one seed as a recording."""
    unknown = np.zeros(len(stamps))
    return Recording(MONOCAB, stamps, {n: table[n][:, seed] if n in table else unknown for n in MONOCAB.names})
