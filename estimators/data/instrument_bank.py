"""Instruments of a regression in closed loop: what filters make of the injected excitation, and of nothing else."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


class InstrumentBank:
    """The excitation through first-order lags: instruments that carry nothing but what was injected.

    Time constants from 1/32 s to 1 s span a vehicle's response. It is another one to what is injected into the closed
    loop than to what alone drives the actuators, as the step from rest does, so each has lags of its own.
    """

    RATES = 2.0 ** np.arange(6)
    COUNT = 2 * (len(RATES) + 1)
    ALONE = 1e-3
    """rad/s between excitation and setpoint, at most, where the excitation is all of it."""

    def __init__(self) -> None:
        self._lags: NDArray[np.float64] = np.zeros((len(self.RATES), 2))
        self._held = np.zeros(2)

    def update(self, spacing: float, excitation: float, setpoint: float) -> None:
        """The next value, which is held until the one after."""
        self._lags += -np.expm1(-self.RATES * spacing)[:, None] * (self._held - self._lags)
        alone = abs(setpoint - excitation) < self.ALONE
        self._held = np.array((0.0, excitation) if alone else (excitation, 0.0))

    @property
    def outputs(self) -> NDArray[np.float64]:
        return np.concatenate((self._lags.ravel(), self._held))

    def reset(self) -> None:
        self._lags[:] = 0.0
        self._held[:] = 0.0
