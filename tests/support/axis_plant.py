"""A mass on a spring under feedback, with a force held between samples: an axis into which tests put missing forces.

mass x'' = force - stiffness x + missing(time, x, x'), integrated ten times finer than it is sampled. The position is
measured with white noise.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from upright.models.library.axis import axis
from upright.models.model import Model
from upright.models.parts import Parameter
from upright.telemetry.channels import Channel, ChannelTable
from upright.telemetry.recording import Recording

MASS, STIFFNESS = 2.0, 50.0
NOISE = 2e-5
"""m, of the position."""
CHANNELS = ChannelTable((Channel("position", "m", "of the mass"), Channel("force", "N", "on it")))


def model(process_noise: float = 1e-3) -> Model:
    """The true mass and spring."""
    spring = Parameter("stiffness", "N/m", STIFFNESS, scale=STIFFNESS, meaning="of the spring")
    return axis(
        inertia=MASS,
        load="-stiffness * position",
        more_parameters=(spring,),
        position_noise=1e-4,
        process_noise=process_noise,
        force_scale=1.0,
    )


def nothing(time: float, position: float, rate: float) -> float:
    return 0.0


def record(
    missing: Callable[[float, float, float], float] = nothing,
    *,
    seed: int = 1,
    duration: float = 20.0,
    source: str = "axis",
) -> Recording:
    """200 samples per second with random pushes, low-passed at about 2 Hz, and some damping by feedback."""
    random = np.random.default_rng(seed)
    spacing, finer = 0.005, 10
    count = round(duration / spacing)
    position, rate, push = 0.0, 0.0, 0.0
    table = np.empty((2, count))
    step = spacing / finer
    for row in range(count):
        measured = position + NOISE * random.standard_normal()
        push += spacing * 12.0 * (-push) + 1.5 * random.standard_normal() * np.sqrt(spacing) * 12.0
        force = push - 4.0 * rate
        table[:, row] = measured, force
        for part in range(finer):
            time = row * spacing + part * step
            # Leapfrog: the error of a step is 1e-4 of the noise.
            rate += 0.5 * step * (force - STIFFNESS * position + missing(time, position, rate)) / MASS
            position += step * rate
            rate += 0.5 * step * (force - STIFFNESS * position + missing(time + step, position, rate)) / MASS
    stamps = (np.arange(count) * spacing * 1e9).round().astype(np.int64)
    return Recording(CHANNELS, stamps, {"position": table[0], "force": table[1]}, source=source)
