"""A narrow-band random torque on a virtual vehicle: a mode of the body, or rail joints at constant speed.

    x' = w v,   v' = -w x - 2 damping w v + 2 sqrt(damping w) rms n,   w = 2 pi frequency,   n: white, of unit density

The torque is x: the response of a mode to white noise. Stationary from the first step on: mean 0, x and v of the
standard deviation `rms` and independent. Discretised exactly at the plant's own step h and held over it: the step's
transition is F = exp(A h), and its noise has the covariance rms^2 (1 - F F'). SI units.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from upright.simulation.physics.disturbance import NOISE_BLOCK

STREAM = 25
"""Spawn key of the torque's random numbers, which nothing else with the same seed shares."""


@dataclass(frozen=True, slots=True)
class NarrowBand:
    """A random torque around a frequency, with the sign of the angle that it acts on.

    Raises:
        ValueError: a number is out of its range.
    """

    rms: float
    """N m, above 0."""
    frequency: float
    """Hz, above 0."""
    damping: float
    """Damping ratio, between 0 and 1: half the power is within about 2 damping x frequency."""
    onset: float | None = None
    """s after the first SYNC at which it sets in; None: it acts from the beginning."""

    def __post_init__(self) -> None:
        if not (math.isfinite(self.rms) and self.rms > 0.0):
            raise ValueError(f"the RMS of the narrow band cannot be {self.rms:g} N m")
        if not (math.isfinite(self.frequency) and self.frequency > 0.0):
            raise ValueError(f"the frequency of the narrow band cannot be {self.frequency:g} Hz")
        if not 0.0 < self.damping < 1.0:
            raise ValueError(f"the damping ratio of the narrow band cannot be {self.damping:g}")
        if self.onset is not None and not (math.isfinite(self.onset) and self.onset >= 0.0):
            raise ValueError(f"the narrow band cannot set in at {self.onset:g} s")

    def __str__(self) -> str:
        late = "" if self.onset is None else f", from {self.onset:g} s on"
        return f"{self.rms:g} N m RMS about {self.frequency:g} Hz, damping ratio {self.damping:g}{late}"


class NarrowBandTorque:
    """A realisation of `narrow_band`: `torque` gives the next value, once per integration step of `step` s."""

    def __init__(self, narrow_band: NarrowBand, step: float, seed: int) -> None:
        forth = _transition(narrow_band, step)
        driven = np.linalg.cholesky(np.eye(2) - forth @ forth.T)
        (self._xx, self._xv), (self._vx, self._vv) = forth.tolist()
        (self._x_of, _), (self._v_of, self._v_own) = (narrow_band.rms * driven).tolist()
        self._rms = narrow_band.rms
        self._onset = -math.inf if narrow_band.onset is None else narrow_band.onset
        self._seed = seed
        self.restart()

    def restart(self) -> None:
        """Restart, as at the start: what follows depends on the seed alone."""
        self._random = np.random.default_rng(np.random.SeedSequence(self._seed, spawn_key=(STREAM,)))
        self._noise: list[list[float]] = []
        self._x, self._v = (self._rms * self._random.standard_normal(2)).tolist()

    def torque(self, event_clock: float) -> float:
        """N m over this step, which begins `event_clock` s after the first SYNC; 0 before the onset."""
        x, v = self._x, self._v
        if not self._noise:
            self._noise = self._random.standard_normal((NOISE_BLOCK, 2)).tolist()
        one, other = self._noise.pop()
        self._x = self._xx * x + self._xv * v + self._x_of * one
        self._v = self._vx * x + self._vv * v + self._v_of * one + self._v_own * other
        return x if event_clock >= self._onset else 0.0


def _transition(narrow_band: NarrowBand, step: float) -> NDArray[np.float64]:
    """exp(A step) of (x, v), (2, 2): a damped rotation."""
    turn = 2.0 * math.pi * narrow_band.frequency * step
    damping = narrow_band.damping
    damped = math.sqrt(1.0 - damping**2)
    cosine, sine = math.cos(damped * turn), math.sin(damped * turn) / damped
    turned = np.array([[cosine + damping * sine, sine], [-sine, cosine - damping * sine]])
    return np.asarray(math.exp(-damping * turn) * turned)
