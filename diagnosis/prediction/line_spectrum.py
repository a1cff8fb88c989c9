"""The multisine that determines parameters best: its line spectrum and its phases, for channels with limits.

A vehicle in its closed loop is nearly linear, so that orthogonal lines add up: the information of a record is

    M(p) = still + sum over lines f of  p_f lines_f,        p_f the square of the amplitude of line f

and the mean square of a channel c is sum over f of p_f |transfer_cf|^2 / 2. The spectrum minimises the
log-determinant of the covariance of the parameters in question, a convex function of p, with that mean square limited
in each channel (D_s-optimality: Goodwin and Payne, "Dynamic system identification", 1977, chapter 6; Pintelon and
Schoukens, "System identification", 2nd ed., section 5.4). The phases then minimise the highest peak over all channels,
each over its limit, by norms of rising order, since the maximum itself has no derivative (Guillaume, Schoukens,
Pintelon and Kollar, "Crest factor minimization using nonlinear Chebyshev approximation methods", IEEE Trans. Instrum.
Meas. 40, 1991).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

CREST = 2.0
"""Crest factor of a channel for which the spectrum is chosen; the amplitude follows from the actual one."""
ORDERS = (4, 8, 16, 32)
"""Of the norms that approach the maximum."""
STARTS, SEED = 6, 50
"""Start values of the phases: Schroeder's and random ones."""
PER_PERIOD = 16
"""Samples of the shortest period at which peaks are looked for."""
FAINT = 1e-3
"""Share of the strongest line's power below which a line is left out."""


@dataclass(frozen=True, slots=True)
class Lines:
    """Lines at `frequency` (f,) Hz, each with whole periods in a record of `span` s: `still` (p, p) is the information
    of a record without excitation, `lines` (f, p, p) what each adds at an amplitude of 1; `transfer` (c, f) from the
    excitation to the channels, over their limits."""

    frequency: Array
    still: Array
    lines: Array
    transfer: Complex
    span: float

    def of(self, kept: NDArray[np.bool_]) -> Lines:
        """Only the lines that are `kept` (f,)."""
        return Lines(self.frequency[kept], self.still, self.lines[kept], self.transfer[:, kept], self.span)


def power(lines: Lines, about: Sequence[int]) -> Array:
    """The squares of the amplitudes (f,) that determine the parameters at the places `about` best, so that the mean
    square of no channel exceeds that of a signal with its limit as peak."""
    others = [place for place in range(len(lines.still)) if place not in about]
    squares = 0.5 * np.abs(lines.transfer) ** 2 * CREST**2
    unit = 1.0 / (len(lines.frequency) * np.max(squares, axis=0))

    def matrix(share: Array) -> Array:
        return np.asarray(lines.still + np.tensordot(share * unit, lines.lines, axes=1))

    def cost(share: Array) -> tuple[float, Array]:
        whole = matrix(share)
        value = -float(np.linalg.slogdet(whole)[1])
        slope = -np.einsum("ij,fji->f", np.linalg.inv(whole), lines.lines)
        if others:
            value += float(np.linalg.slogdet(_part(whole, others))[1])
            slope = slope + np.einsum("ij,fji->f", np.linalg.inv(_part(whole, others)), _part(lines.lines, others))
        return value, slope * unit

    found = minimize(
        cost,
        np.ones(len(unit)),
        jac=True,
        method="SLSQP",
        bounds=[(0.0, None)] * len(unit),
        constraints=[
            {"type": "ineq", "fun": lambda share: 1.0 - squares @ (share * unit), "jac": lambda share: -squares * unit}
        ],
        options={"maxiter": 500, "ftol": 1e-9},
    )
    best: Array = np.maximum(found.x, 0.0) * unit
    return np.where(best >= FAINT * np.max(best), best, 0.0)


def _part(matrices: Array, places: Sequence[int]) -> Array:
    """The rows and columns `places` of matrices (..., p, p)."""
    return np.asarray(matrices[..., list(places), :][..., list(places)])


def phases(lines: Lines, amplitude: Array) -> tuple[Array, float]:
    """The phases (f,), rad, with the least peak, and that peak, over the limit of the channel that has it."""
    omega = 2.0 * np.pi * lines.frequency
    time = np.arange(0.0, lines.span, 1.0 / (PER_PERIOD * float(np.max(lines.frequency))))
    turning = np.exp(1j * np.outer(time, omega))
    weights = amplitude * lines.transfer

    def signals(phase: Array) -> Complex:
        return np.asarray((weights * np.exp(1j * phase)) @ turning.T)

    def norm(phase: Array, order: int) -> tuple[float, Array]:
        y = signals(phase)
        real, highest = y.real, float(np.max(np.abs(y.real)))
        relative = (real / highest) ** (order - 1)
        mean = float(np.mean((real / highest) ** order))
        value = highest * mean ** (1.0 / order)
        # d real / d phase_f = -Im(weights e^{i phase} e^{i omega t})
        by = -np.einsum("ct,cf,tf->f", relative, weights * np.exp(1j * phase), turning).imag / real.size
        return value, by * mean ** (1.0 / order - 1.0)

    random = np.random.default_rng(SEED)
    share = amplitude**2 / np.sum(amplitude**2)
    schroeder = -2.0 * np.pi * (np.cumsum(np.cumsum(share)) - np.cumsum(share))
    starts = [schroeder, *random.uniform(-np.pi, np.pi, (STARTS - 1, len(amplitude)))]
    best, least = schroeder, np.inf
    for phase in starts:
        for order in ORDERS:
            phase = minimize(norm, phase, (order,), jac=True, method="L-BFGS-B", options={"maxiter": 200}).x
        peak = float(np.max(np.abs(signals(phase).real)))
        if peak < least:
            best, least = phase, peak
    return np.asarray(np.mod(best, 2.0 * np.pi)), least
