"""The random disturbance of a virtual vehicle: a first-order (Ornstein-Uhlenbeck) torque on the axis it falls about.

    d' = -d / T + sqrt(2 / T) rms w,    w: white noise of unit two-sided density

Stationary from the first step on: mean 0, standard deviation `rms`, autocorrelation exp(-|lag| / T), T the correlation
time. Discretised exactly at the plant's own step h and held over it (C. W. Gardiner, Handbook of Stochastic Methods,
section 4.4.4):  d(k+1) = a d(k) + rms sqrt(1 - a^2) n(k),  a = exp(-h / T),  n standard normal. SI units.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

NOISE_BLOCK = 2048
STREAM = 24
"""Spawn key of the torque's random numbers. It makes them independent of those that the seed alone gives (the IMU's,
the jitter's), without changing those."""


@dataclass(frozen=True, slots=True)
class Disturbance:
    """A random torque, with the sign of the angle that it acts on.

    Raises:
        ValueError: a number is out of its range.
    """

    rms: float
    """N m, above 0."""
    correlation_time: float
    """s, above 0: after it the autocorrelation is 1/e."""
    onset: float | None = None
    """s after the first SYNC at which it sets in; None: it acts from the beginning."""

    def __post_init__(self) -> None:
        if not (math.isfinite(self.rms) and self.rms > 0.0):
            raise ValueError(f"the RMS of the disturbance cannot be {self.rms:g} N m")
        if not (math.isfinite(self.correlation_time) and self.correlation_time > 0.0):
            raise ValueError(f"the correlation time of the disturbance cannot be {self.correlation_time:g} s")
        if self.onset is not None and not (math.isfinite(self.onset) and self.onset >= 0.0):
            raise ValueError(f"the disturbance cannot set in at {self.onset:g} s")

    def __str__(self) -> str:
        late = "" if self.onset is None else f", from {self.onset:g} s on"
        return f"{self.rms:g} N m RMS, correlation time {self.correlation_time:g} s{late}"


class RandomTorque:
    """A realisation of `disturbance`: `torque` gives the next value, once per integration step of `step` s."""

    def __init__(self, disturbance: Disturbance, step: float, seed: int) -> None:
        ratio = step / disturbance.correlation_time
        self._memory = math.exp(-ratio)
        self._scale = disturbance.rms * math.sqrt(-math.expm1(-2.0 * ratio))
        self._rms = disturbance.rms
        self._onset = -math.inf if disturbance.onset is None else disturbance.onset
        self._seed = seed
        self.restart()

    def restart(self) -> None:
        """Restart, as at the start: what follows depends on the seed alone."""
        self._random = np.random.default_rng(np.random.SeedSequence(self._seed, spawn_key=(STREAM,)))
        self._noise: list[float] = []
        self._value = self._rms * float(self._random.standard_normal())

    def torque(self, event_clock: float) -> float:
        """N m over this step, which begins `event_clock` s after the first SYNC; 0 before the onset."""
        value = self._value
        if not self._noise:
            self._noise = self._random.standard_normal(NOISE_BLOCK).tolist()
        self._value = self._memory * value + self._scale * self._noise.pop()
        return value if event_clock >= self._onset else 0.0
