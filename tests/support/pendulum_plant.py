"""A pendulum turned by a motor, on a bench: a user's own machine, for which there is no vehicle file.

inertia angle'' = motor_constant voltage - stiffness sin(angle) + missing(time, angle, rate), by the midpoint rule at
4 kHz. A PD controller follows a multisine; the recording is a table of time, voltage and angle, as a user has it.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

import numpy as np

Missing = Callable[[float, float, float], float]

INERTIA, STIFFNESS, MOTOR_CONSTANT = 0.62, 11.5, 0.3
"""kg m^2, N m/rad, N m/V."""
SUPPLY = 24.0
"""V."""
NOISE = 1e-4
"""rad, of the angle."""
SPACING, FINER = 0.005, 20
"""s between samples, and steps of the plant from one to the next."""
FREQUENCIES = np.array([0.2, 0.35, 0.6, 0.9, 1.3, 1.9, 2.6, 3.4])
"""Hz, of the reference."""


def nothing(time: float, angle: float, rate: float) -> float:
    return 0.0


def write(
    path: Path,
    missing: Missing = nothing,
    *,
    seed: int,
    duration: float = 30.0,
    dead_band: float = 0.0,
    late: float = 0.0,
    early: float = 0.0,
) -> Path:
    """Write the table of a run to `path`. `dead_band` V of the motor. The recorded angle is `late` s old.

    The voltage of a row of the table acts `early` s before its angle is measured, at most until the next row.
    """
    random = np.random.default_rng(seed)
    count = round(duration / SPACING)
    phases = random.uniform(0.0, 2.0 * math.pi, len(FREQUENCIES))
    instants = np.arange(count) * SPACING
    waves = np.sin(2.0 * math.pi * np.outer(instants, FREQUENCIES) + phases) / np.sqrt(1.0 + FREQUENCIES)
    reference, noise = (0.16 * waves.sum(axis=1)).tolist(), (NOISE * random.standard_normal(count)).tolist()
    step, behind, ahead = SPACING / FINER, round(late * FINER / SPACING), round(early * FINER / SPACING)
    angle, rate, before, speed = 0.0, 0.0, 0.0, 0.0
    past = [0.0] * (behind + 1)
    rows = ["time,voltage,angle"]
    for row in range(count):
        reading = past[-1 - behind] + noise[row]
        speed = 0.7 * speed + 0.3 * (reading - before) / SPACING
        before = reading
        wanted = (
            60.0 * (reference[row] - reading)
            - 6.0 * speed
            + 0.8 * STIFFNESS / MOTOR_CONSTANT * math.sin(reference[row])
        )
        voltage = min(SUPPLY, max(-SUPPLY, wanted))
        torque = MOTOR_CONSTANT * math.copysign(max(abs(voltage) - dead_band, 0.0), voltage)
        for part in range(FINER):
            time = float(instants[row]) + (part + 0.5) * step
            push = torque - STIFFNESS * math.sin(angle) + missing(time, angle, rate)
            middle, fast = angle + 0.5 * step * rate, rate + 0.5 * step * push / INERTIA
            push = torque - STIFFNESS * math.sin(middle) + missing(time, middle, fast)
            angle, rate = angle + step * fast, rate + step * push / INERTIA
            past.append(angle)
        shown = past[len(past) - 1 - FINER + ahead] + noise[row] if ahead else reading
        rows.append(f"{instants[row]:.4f},{voltage:.6f},{shown:.8f}")
        del past[: -1 - behind]
    path.write_text("\n".join(rows) + "\n")
    return path
