"""A MONOCAB that others recorded: sensors, loop and speed loop are not those of the virtual vehicle.

Roll is an encoder's with white noise, the gyro is as noisy as cheap ones are, the controller a plain PD whose setpoint
acts at once, the gimbals one first-order lag. So the drives answer to a row's noise before the next row. Written apart
from `simulation` and `models`; steps of a tenth of a millisecond, by the midpoint rule.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

STEP = 1e-4
INERTIA, STIFFNESS, MOMENTUM, LAG = 1560.0, 13400.0, 3300.0, 0.04
FREQUENCIES = np.array([0.13, 0.31, 0.53, 0.89, 1.31, 1.9, 2.7, 3.9])
CHANNELS = (
    "time",
    "roll",
    "roll_rate",
    "precession",
    "precession_rate",
    "precession_rate_setpoint",
    "trim_position",
    "trim_rate",
    "trim_rate_setpoint",
)


def nothing(time: float, roll: float, roll_rate: float) -> float:
    return 0.0


@dataclass
class OthersVehicle:
    """`torque` (N m) of time, roll and roll rate is what a model lacks; `command` is what the drives make of a
    setpoint, `delay` in rows and `further_lag` in s are what it meets besides."""

    torque: Callable[[float, float, float], float] = nothing
    command: Callable[[float], float] = float
    delay: int = 0
    further_lag: float = 0.0
    rate: int = 200
    noise: float = 5.0
    """Of 2e-5 rad and 3e-4 rad/s a sample."""
    seed: int = 0
    state: list[float] = field(default_factory=lambda: [0.002, 0.0, 0.0, 0.0, 0.0])
    """Roll, its rate, precession, its rate, and the setpoint behind the further lag."""

    def write(self, path: Path, seconds: float = 40.0) -> Path:
        """A table of the channels that the manual asks for."""
        random = np.random.default_rng(self.seed)
        phases = random.uniform(0.0, 2.0 * np.pi, FREQUENCIES.size)
        rows: list[list[float]] = []
        for row in range(round(seconds * self.rate)):
            time = row / self.rate
            roll = self.state[0] + self.noise * 2e-5 * random.standard_normal()
            roll_rate = self.state[1] + self.noise * 3e-4 * random.standard_normal()
            precession_rate = self.state[3] + self.noise * 1e-4 * random.standard_normal()
            excitation = 0.06 * float(np.sum(np.sin(2.0 * np.pi * FREQUENCIES * time + phases)))
            lean = 0.012 * self.state[2]
            setpoint = float(np.clip(-18.0 * (roll + lean) - 5.2 * roll_rate + excitation, -1.0, 1.0))
            rows.append([time, roll, roll_rate, self.state[2], precession_rate, setpoint, 0.0, 0.0, 0.0])
            self._advance(time, self.command(rows[max(0, row - self.delay)][5]))
        np.savetxt(path, np.array(rows), delimiter=",", header=",".join(CHANNELS), comments="", fmt="%.8g")
        return path

    def _advance(self, time: float, setpoint: float) -> None:
        for step in range(round(1.0 / self.rate / STEP)):
            now = time + step * STEP
            half = self._moved(0.5 * STEP, self._slopes(now, setpoint, self.state))
            self.state = self._moved(STEP, self._slopes(now + 0.5 * STEP, setpoint, half))

    def _moved(self, by: float, slopes: list[float]) -> list[float]:
        return [value + by * slope for value, slope in zip(self.state, slopes, strict=True)]

    def _slopes(self, time: float, setpoint: float, state: list[float]) -> list[float]:
        roll, roll_rate, _, precession_rate, late = state
        torque = STIFFNESS * math.sin(roll) + MOMENTUM * precession_rate + self.torque(time, roll, roll_rate)
        acting = late if self.further_lag else setpoint
        return [
            roll_rate,
            torque / INERTIA,
            precession_rate,
            (acting - precession_rate) / LAG,
            (setpoint - late) / self.further_lag if self.further_lag else 0.0,
        ]
