"""An independent MONOCAB with a random disturbance, for tests: roll, gimbals with a lag, a controller, a random torque.

It uses nothing of the models: Euler's method at 1 ms, gravity with the sine of the roll, measurements with white noise,
and a random torque d' = -d / correlation_time + w. Records have the form that a user has: a table of channels.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from monocab_channels import MONOCAB

from upright.telemetry.channels import ChannelTable
from upright.telemetry.recording import Recording

STEP = 1e-3
ROWS = 5
"""Integration steps per sample: 200 Hz."""
LINES = np.array([0.13, 0.31, 0.57, 0.9, 1.4, 2.1])
"""Hz, of the multisine."""


@dataclass(frozen=True, slots=True)
class Shaken:
    """`rms` N m and `correlation_time` s of the random torque, `gust` times as large from `gust_from` to `gust_to` s;
    `more(time, roll, roll_rate)` N m is a torque that a model may lack."""

    rms: float = 8.0
    correlation_time: float = 0.3
    gust: float = 1.0
    gust_from: float = 0.0
    gust_to: float = 0.0
    more: Callable[[float, float, float], float] | None = None
    inertia: float = 1620.0
    gravity_stiffness: float = 13650.0
    angular_momentum: float = 3300.0

    def record(self, seed: int, seconds: float = 30.0) -> Recording:
        """A closed-loop run with a multisine on the roll reference."""
        random = np.random.default_rng(seed)
        phases = random.uniform(0.0, 2.0 * np.pi, len(LINES))
        kicks = random.standard_normal(round(seconds / STEP))
        fading = np.exp(-STEP / self.correlation_time)
        driven = self.rms * np.sqrt(1.0 - fading**2)
        roll = rate = precession = gimbals = torque = setpoint = 0.0
        rows: list[tuple[float, ...]] = []
        for number, kick in enumerate(kicks.tolist()):
            time = number * STEP
            if number % ROWS == 0:
                reference = 0.005 * float(np.sum(np.sin(2.0 * np.pi * LINES * time + phases)))
                setpoint = float(np.clip(-30.0 * (roll - reference) - 9.0 * rate, -2.0, 2.0))
                rows.append((time, roll, rate, precession, gimbals, setpoint))
            torque = fading * torque + driven * kick
            pushed = torque * (self.gust if self.gust_from < time < self.gust_to else 1.0)
            if self.more is not None:
                pushed += self.more(time, roll, rate)
            gimbals += (setpoint - gimbals) / 0.04 * STEP
            precession += gimbals * STEP
            load = self.gravity_stiffness * np.sin(roll) + self.angular_momentum * gimbals + pushed
            rate += float(load) / self.inertia * STEP
            roll += rate * STEP
        table = np.array(rows)
        noise = random.standard_normal((4, len(table)))
        values = {
            "roll": table[:, 1] + 1e-4 * noise[0],
            "roll_rate": table[:, 2] + 4e-4 * noise[1],
            "precession": table[:, 3] + 1e-4 * noise[2],
            "precession_rate": table[:, 4] + 2e-4 * noise[3],
            "precession_rate_setpoint": table[:, 5],
            **dict.fromkeys(("trim_position", "trim_rate", "trim_rate_setpoint"), np.zeros(len(table))),
            "gyro_bias_std": np.full(len(table), 6.9e-4),
            "drive_age": np.zeros(len(table)),
        }
        channels = ChannelTable(channel for channel in MONOCAB if channel.name in values)
        return Recording(channels, np.round(table[:, 0] * 1e9).astype(np.int64), values, source=f"shaken {seed}")
