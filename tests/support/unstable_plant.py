"""A mass that a position-dependent force drives off the middle, held there by feedback: the smallest unstable plant.

mass x'' = force + drive x + disturbance, with a pole at sqrt(drive / mass) = 5 rad/s, by leapfrog ten times finer than
it is sampled. The force is held between samples, the position is measured with white noise.
"""

from __future__ import annotations

import numpy as np
from axis_plant import CHANNELS

from upright.models.library.axis import axis
from upright.models.model import Model
from upright.models.parts import Parameter
from upright.telemetry.recording import Recording

MASS, DRIVE = 2.0, 50.0
"""kg, N/m."""
NOISE = 2e-5
"""m, of the position."""
SPACING, FINER = 0.005, 10


def model() -> Model:
    """The true equations, with values from a drawing that are 15 to 20 % off."""
    drive = Parameter("drive", "N/m", 40.0, scale=DRIVE, meaning="of the force that grows with the distance")
    return axis(
        inertia=1.7,
        load="drive * position",
        more_parameters=(drive,),
        position_noise=1e-4,
        process_noise=1e-2,
        force_scale=1.0,
    )


def record(*, seed: int = 1, duration: float = 20.0, disturbance: float = 0.5) -> Recording:
    """`disturbance` is white force noise, N/sqrt(Hz), in addition to known pushes of 7.3 N RMS."""
    random = np.random.default_rng(seed)
    position, rate, push, before, speed = 0.0, 0.0, 0.0, 0.0, 0.0
    table = np.empty((2, round(duration / SPACING)))
    step = SPACING / FINER
    for row in range(table.shape[1]):
        measured = position + NOISE * random.standard_normal()
        speed = 0.7 * speed + 0.3 * (measured - before) / SPACING
        before = measured
        push += -12.0 * SPACING * push + 36.0 * random.standard_normal() * np.sqrt(SPACING)
        force = push - 120.0 * measured - 20.0 * speed
        table[:, row] = measured, force
        force += disturbance * random.standard_normal() / np.sqrt(SPACING)
        for _ in range(FINER):
            rate += 0.5 * step * (force + DRIVE * position) / MASS
            position += step * rate
            rate += 0.5 * step * (force + DRIVE * position) / MASS
    stamps = (np.arange(table.shape[1]) * SPACING * 1e9).round().astype(np.int64)
    return Recording(CHANNELS, stamps, {"position": table[0], "force": table[1]}, source="unstable")
