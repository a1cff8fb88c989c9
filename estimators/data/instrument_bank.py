"""Instruments of a regression in closed loop: the injected excitation through filters."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


class InstrumentBank:
    """The excitation through first-order lags: instruments that depend on the injected signal only.

    Time constants from 1/32 s to 1 s span a vehicle's response. The response to a signal that is added to the
    controller's differs from the response to one that drives the actuators alone, as the step from rest does. So each
    has its own lags.
    """

    RATES = 2.0 ** np.arange(6)
    COUNT = 2 * (len(RATES) + 1)
    ALONE = 1e-3
    """rad/s, largest difference between excitation and setpoint at which the excitation alone drives the actuators."""

    def __init__(self) -> None:
        self._lags: NDArray[np.float64] = np.zeros((len(self.RATES), 2))
        self._held = np.zeros(2)

    def update(self, spacing: float, excitation: float, setpoint: float) -> None:
        """Take the next value, which is held until the following one."""
        self._lags += -np.expm1(-self.RATES * spacing)[:, None] * (self._held - self._lags)
        alone = abs(setpoint - excitation) < self.ALONE
        self._held = np.array((0.0, excitation) if alone else (excitation, 0.0))

    @property
    def outputs(self) -> NDArray[np.float64]:
        return np.concatenate((self._lags.ravel(), self._held))

    def reset(self) -> None:
        self._lags[:] = 0.0
        self._held[:] = 0.0
