"""State-variable filter: every signal of an equation through the same low-pass, together with its derivatives.

A differential equation that holds for the signals also holds for the filtered signals, if all of them go through the
same linear filter F(s). F is a Butterworth low-pass of order n,

    F(s) = wc^n / prod (s - p_i) = sum c_i / (s - p_i),    x_F^(j) = sum c_i p_i^j z_i,    z_i' = p_i z_i + x,

and its modes z_i give the filtered signal and its derivatives up to n - 1 without differencing. The modes are
discretised exactly for an input that is linear between two samples (first-order hold), at any spacing. So jitter of
the time stamps causes no error, and there is no half-sample delay between a value and its derivative.

Two details make short records usable from their first sample:

* The filter starts at rest, with the start value subtracted from every input. The filtered derivative is then exactly F
  applied to the true derivative, and a constant term of the equation becomes the filter's step response, which is
  output with the signals. There is no transient to wait for.
* `outputs(ahead)` returns the filtered signals a little after the last sample, with the input held. This brings signals
  that were sampled at different instants to a common one, with an error of the order (wc * ahead)^n / n!.

Source: Isermann and Muenchhof, Identification of Dynamic Systems, section 15.1 (state-variable filters); Young,
Recursive Estimation and Time-Series Analysis, chapter 8.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from upright.estimators.contract import EstimationError

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]


class StateVariableFilter:
    """Butterworth state-variable filter of `order` (2 or more) at `bandwidth` rad/s for `signals` signals at once.

    Raises EstimationError if order or bandwidth is invalid.
    """

    def __init__(self, signals: int, bandwidth: float, order: int = 4) -> None:
        if order < 2:
            raise EstimationError("state-variable filter", f"order {order} has no derivative", remedy="use 2 or more.")
        if not bandwidth > 0.0:
            raise EstimationError("state-variable filter", f"bandwidth {bandwidth} rad/s", remedy="use one above 0.")
        self.bandwidth = bandwidth
        self.order = order
        angles = np.pi * (2 * np.arange(order) + order + 1) / (2 * order)
        poles = bandwidth * np.exp(1j * angles)
        residues = np.array([bandwidth**order / np.prod(pole - np.delete(poles, i)) for i, pole in enumerate(poles)])
        upper = poles.imag > -1e-9 * bandwidth
        pairs = np.where(poles[upper].imag > 1e-9 * bandwidth, 2.0, 1.0)
        self._poles: ComplexArray = poles[upper][:, None]
        self._readout: ComplexArray = (pairs * residues[upper]) * poles[upper] ** np.arange(order)[:, None]
        self._modes: ComplexArray = np.zeros((int(upper.sum()), signals + 1), dtype=np.complex128)
        self._start: Array = np.zeros(signals)
        self._input: Array = np.zeros(signals + 1)
        self._spacing = -1.0
        self._coefficients: tuple[ComplexArray, ...] = ()

    def start(self, values: ArrayLike) -> None:
        """Start at rest at the first sample `values`, shape (signals,)."""
        self._start = np.array(values, dtype=np.float64)
        self._modes[:] = 0.0
        self._input = np.zeros(len(self._start) + 1)
        self._input[-1] = 1.0

    def update(self, spacing: float, values: ArrayLike) -> None:
        """Take the next sample `values`, shape (signals,), `spacing` seconds after the last; ignored if `spacing` is 0
        or less."""
        if spacing <= 0.0:
            return
        if spacing != self._spacing:
            exponent = self._poles * spacing
            growth: ComplexArray = np.expm1(exponent)
            self._coefficients = (
                growth + 1.0,
                growth / self._poles,
                (growth - exponent) / (self._poles * exponent),
            )
            self._spacing = spacing
        decay, held, ramp = self._coefficients
        following = np.empty_like(self._input)
        np.subtract(values, self._start, out=following[:-1])
        following[-1] = 1.0
        self._modes = decay * self._modes + held * self._input + ramp * (following - self._input)
        self._input = following

    def outputs(self, ahead: float = 0.0) -> Array:
        """The filtered signals and their derivatives `ahead` seconds after the last sample, input held.

        Shape (order, signals + 1): row j is the j-th derivative. The last column is the constant 1, filtered since the
        start, and its derivatives.
        """
        modes = self._modes
        if ahead != 0.0:
            growth = np.expm1(self._poles * ahead)
            modes = (growth + 1.0) * modes + growth / self._poles * self._input
        outputs: Array = (self._readout @ modes).real
        outputs[0, :-1] += self._start * outputs[0, -1]
        return outputs
