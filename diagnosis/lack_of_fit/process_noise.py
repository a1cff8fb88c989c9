"""How much of a model's stated process noise a record really shows: shares of its variances, 1 at most.

The stated noise is where the estimation of the noise begins, and a model that states a hundred times too much would
hide every missing effect in its floor. By the linearised model, the innovations of the predictor with the stated noise
have the power density

    Phi(f) = [G I] [[share Q + .., ..], [.., R]] [G I]*,    G = C (z I - A + A K C)^-1,

affine in the share of each noise; the most likely shares are found in the frequency domain. None may exceed 1:
otherwise the error of a wrong model would be called noise. Source: Whittle, Arkiv foer Matematik 2 (1953) 423-434.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
System = tuple[Array, Array, Array, Array, Array]
"""A (nx, nx), C (ny, nx), the covariances of process noise and of sensor noise, and their cross-covariance."""

BINS = 200
"""Bins of the periodogram, evenly spaced on a logarithmic axis: densities are smooth."""
SHARES = np.logspace(-10.0, 0.0, 81)
ROUNDS = 2
"""Rounds in which each share is found in turn, with the others fixed."""


def shown_shares(
    errors: Sequence[Array], gain: Array, without: System, stated: Sequence[System], outputs: Sequence[int]
) -> Array:
    """The share of each process noise, 0 to 1, that `errors` show: innovations by segment (n, ny) with `gain` (nx, ny).

    `without` is the system with none of these noises, `stated` the same with one of them each; `outputs` are the
    informative ones. The shares are one standard deviation above the most likely ones, so that a noise is overestimated
    rather than underestimated; a noise that does not show at all stays as stated.
    """
    turns, spectra = [], []
    for part in errors:
        lines = np.fft.rfft(np.nan_to_num(part[:, outputs]), axis=0)[1:] / np.sqrt(len(part))
        turns.append(2.0 * np.pi * np.arange(1, len(lines) + 1) / len(part))
        spectra.append(lines)
    order = np.argsort(np.concatenate(turns))
    turn, lines = np.concatenate(turns)[order], np.concatenate(spectra)[order]
    starts = np.unique(np.geomspace(1, len(turn), BINS).astype(int)) - 1
    counts = np.diff(np.append(starts, len(turn)))
    powers = np.add.reduceat(lines[:, :, None] * np.conj(lines[:, None, :]), starts) / counts[:, None, None]
    middle = np.add.reduceat(turn, starts) / counts
    none, *with_one = (density(middle, gain, system)[:, outputs][:, :, outputs] for system in (without, *stated))
    parts = [each - none for each in with_one]

    def cost(share: float, place: int) -> float:
        """Minus the log-likelihood with one share changed."""
        factors = [*shares]
        factors[place] = share
        whole = none + sum(factor * part for factor, part in zip(factors, parts, strict=True))
        _, size = np.linalg.slogdet(whole)
        fit = np.trace(np.linalg.solve(whole, powers), axis1=1, axis2=2).real
        return float(np.sum(counts * (size + fit)))

    shares = np.ones(len(parts))
    for place in [*range(len(parts))] * ROUNDS:
        costs = np.array([cost(float(share), place) for share in SHARES])
        best = int(np.argmin(costs))
        limit = float(costs[best]) + 0.5
        above = np.flatnonzero(costs[best:] > limit)
        shares[place] = SHARES[best + int(above[0])] if len(above) else 1.0
    return shares


def density(turn: Array, gain: Array, system: System) -> NDArray[np.complex128]:
    """Power density of the innovations per sample, at `turn` rad per sample (m,): (m, ny, ny)."""
    transition, output, process, sensor, across = system
    ahead = transition @ gain
    closed = transition - ahead @ output
    driven = process + ahead @ sensor @ ahead.T - across @ ahead.T - ahead @ across.T
    both = across - ahead @ sensor
    states = len(transition)
    resolvent = np.linalg.inv(np.exp(1j * turn)[:, None, None] * np.eye(states) - closed)
    through = output @ resolvent
    back = np.conj(np.swapaxes(through, 1, 2))
    mixed = through @ both
    return np.asarray(through @ driven @ back + mixed + np.conj(np.swapaxes(mixed, 1, 2)) + sensor)
