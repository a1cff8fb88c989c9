"""Recordings of a fleet: pendulums on motors, of which one begins to rub. For `upright fleet`.

    python examples/pendulum_fleet.py FOLDER [RECORDINGS]
    upright fleet FOLDER --model FOLDER/pendulum.toml --effect viscous_friction --report fleet.html

Each of four pendulums is recorded once a week: voltage (V) and angle (rad) at 100 Hz. The dry friction of pendulum_3
doubles in the middle. In every recording, inertia and friction are off by 1 % and 3 % of their own.
"""

from __future__ import annotations

import math
import sys
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np

BEGIN = datetime(2026, 3, 2, 9, tzinfo=UTC)
STEP, EVERY, DURATION = 0.0005, 20, 15.0
"""s of the simulation, steps for each row, s of a recording."""
NOISE = 5e-4
"""rad."""
MODEL = """
title = "Pendulum on a motor, with dry friction"

[parameters]
inertia = { unit = "kg m^2", value = 0.5, std = 0.1, lower = 0.0 }
stiffness = { unit = "N m/rad", value = 9.8, std = 2.0 }
motor_constant = { unit = "N m/V", value = 0.3, std = 0.02, estimated = false }

[states.angle]
unit = "rad"
derivative = "rate"
initial = "angle"
initial_std = 0.1

[states.rate]
unit = "rad/s"
derivative = "pivot_force / inertia"
initial_std = 1.0
process_noise = 0.01

[inputs.voltage]
unit = "V"
hold = "zero_order"

[outputs.angle]
unit = "rad"
expression = "angle"
noise = 5e-4

[joints.pivot]
coordinate = "angle"
rate = "rate"
inertia = "inertia"
load = "motor_constant * voltage - stiffness * sin(angle)"
force_unit = "N m"
coordinate_unit = "rad"
force_scale = 5.0
coordinate_scale = 0.5
rate_scale = 1.0
smooth_rate = 1e-3

[[effects]]
name = "coulomb_friction"
"""


def record(path: Path, began: datetime, friction: float, random: np.random.Generator) -> None:
    """Write the table of one run: a voltage of several sines, held for each row."""
    inertia, friction = 0.62 * random.normal(1.0, 0.01), friction * random.normal(1.0, 0.03)
    angle = rate = 0.0
    phases = random.uniform(0.0, 2.0 * math.pi, 6)
    rows = ["time,voltage,angle"]
    for row in range(round(DURATION / (STEP * EVERY))):
        time = row * STEP * EVERY
        voltage = round(6.0 * float(np.sin(2.0 * math.pi * time * np.geomspace(0.2, 2.0, 6) + phases).sum()), 4)
        rows.append(f"{began.timestamp() + time:.3f},{voltage},{random.normal(angle, NOISE):.7f}")
        for _ in range(EVERY):
            torque = 0.3 * voltage - 11.5 * math.sin(angle) - friction * math.tanh(rate / 1e-3)
            rate += STEP * torque / inertia
            angle += STEP * rate
    path.write_text("\n".join(rows) + "\n")


def main(folder: Path, recordings: int) -> None:
    """A folder a pendulum, and the model beside them."""
    random = np.random.default_rng(1)
    for pendulum in range(1, 5):
        own = folder / f"pendulum_{pendulum}"
        own.mkdir(parents=True, exist_ok=True)
        for week in range(recordings):
            began = BEGIN + timedelta(weeks=week)
            rubs = pendulum == 3 and week >= recordings // 2
            record(own / f"{began:%Y-%m-%d}.csv", began, 0.3 if rubs else 0.15, random)
    (folder / "pendulum.toml").write_text(MODEL)


if __name__ == "__main__":
    main(Path(sys.argv[1]), int(sys.argv[2]) if len(sys.argv) > 2 else 10)
