"""The random disturbance in the record of a case: drawn for each record, a multiple of the sensor floor, or none.

The sensor floor for a correlation time T is the RMS torque due to the gyro's white noise alone: the standard deviation
of a constant torque that is estimated by least squares from the gyro's samples over one T,

    floor = inertia * density * sqrt(6 / T^3)

with the inertia that the torque accelerates (kg m^2) and the gyro's one-sided noise density (rad/s/sqrt(Hz)). n samples
of a rate with the standard deviation s over T give its slope with the standard deviation s sqrt(12 / n) / T, and s is
density * sqrt(n / (2 T)): the sampling rate cancels. A smaller disturbance of this correlation time is not detectable
from one T.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from upright.simulation.config import ImuNode, Truth
from upright.simulation.physics.disturbance import Disturbance
from upright.vehicles import registry

NONE = "none"
"""The entry for records without a disturbance."""
DRAW = 25
"""Spawn key of the random numbers for drawing a disturbance: they are independent of others with the same seed."""

Floor = Callable[[float], float]
"""The sensor floor, N m, as a function of the correlation time, s."""


def sensor_floor(truth: Truth, imu: ImuNode, correlation_time: float) -> float:
    """The sensor floor, N m, see above."""
    return truth.falling_inertia * imu.angular_rate_density * math.sqrt(6.0 / correlation_time**3)


class Disturbances(Protocol):
    """The disturbances of many records."""

    @property
    def conditions(self) -> str:
        """The conditions that results in one file must have in common, as text."""
        ...

    def of(self, seed: int | None, floor: Floor) -> Disturbance:
        """The disturbance of the record with this seed; with None, that of a record representing all of them."""
        ...


@dataclass(frozen=True, slots=True)
class Drawn:
    """RMS (N m) and correlation time (s), both log-uniform between these bounds."""

    rms: tuple[float, float] = (2.0, 20.0)
    correlation_time: tuple[float, float] = (0.05, 3.0)

    @property
    def conditions(self) -> str:
        (low, high), (short, long) = self.rms, self.correlation_time
        return f"disturbance drawn from {low:g} to {high:g} N m RMS and {short:g} to {long:g} s"

    def of(self, seed: int | None, floor: Floor) -> Disturbance:
        """Drawn with the seed; without one, the geometric mean of the bounds. With six digits, as given to `--hide`."""
        shares = [0.5, 0.5]
        if seed is not None:
            shares = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(DRAW,))).uniform(size=2).tolist()
        rms, time = (
            float(f"{low * (high / low) ** share:.6g}")
            for (low, high), share in zip((self.rms, self.correlation_time), shares, strict=True)
        )
        return Disturbance(rms, time)


@dataclass(frozen=True, slots=True)
class Multiple:
    """`floors` times the sensor floor of a correlation time (s), the same in every record."""

    floors: float
    correlation_time: float

    @property
    def conditions(self) -> str:
        return f"disturbance of {self.floors:g} sensor floors and {self.correlation_time:g} s"

    def of(self, seed: int | None, floor: Floor) -> Disturbance:
        return Disturbance(float(f"{self.floors * floor(self.correlation_time):.6g}"), self.correlation_time)


def drawn_for(kind: str) -> Drawn:
    """The range for a kind of vehicle: from a tenth or a fifth of its virtual vehicle's disturbance to a multiple."""
    return Drawn(rms=registry.of(kind).shaken)


def parse_disturbances(text: str | None, default: Disturbances) -> Disturbances | None:
    """`RMS,CORRELATION_TIME` (in sensor floors, and s) or `none`; `default` if nothing is given.

    Raises ValueError with the expected format.
    """
    if text is None:
        return default
    if text.strip() == NONE:
        return None
    try:
        floors, correlation_time = (float(word) for word in text.split(","))
        Disturbance(floors, correlation_time)
    except ValueError:
        message = (
            f"{text!r} is neither RMS,CORRELATION_TIME, both above 0, in multiples of the sensor floor and s, as in "
            f"10,0.3, nor {NONE}"
        )
        raise ValueError(message) from None
    return Multiple(floors, correlation_time)
