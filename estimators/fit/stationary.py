"""The stationary covariance of a stable system that noise drives."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from upright.estimators.contract import EstimationError

Array = NDArray[np.float64]

DOUBLINGS = 60
"""Largest number of doublings, which is more time than any record has."""
SETTLED = 1e-13
"""Largest relative change of the covariance by the last doubling."""


def stationary(transition: Array, driven: Array) -> Array:
    """X = A X A' + Q (nx, nx), of one system (stationary_all). Raises EstimationError if X grows without bound."""
    found = np.asarray(stationary_all(transition, driven[None])[0])
    if np.isfinite(found).all():
        return found
    raise EstimationError(
        "predictor", "its errors grow without bound", remedy="check the values and the noises of the model."
    )


def stationary_all(transition: Array, driven: Array) -> Array:
    """X = A X A' + Q (n, nx, nx) for each of n matrices Q, by doubling: Q + A Q A', then over twice as many samples,
    and so on; NaN if X grows without bound.

    A state that decays slowly or not at all causes no error if nothing drives it, unlike in a linear system of
    equations for all of X at once. Source: Smith, SIAM J. Applied Mathematics 16 (1968) 198.
    """
    found, total, power = np.full(driven.shape, np.nan), driven, transition
    left = np.ones(len(driven), dtype=bool)
    with np.errstate(over="ignore", invalid="ignore"):
        for _ in range(DOUBLINGS):
            more = power @ total @ power.T
            total = total + more
            largest = np.abs(total).max(axis=(1, 2), initial=0.0)
            # Kept at once: a state that grows, but that nothing drives, makes later sums overflow.
            settled = left & (np.abs(more).max(axis=(1, 2), initial=0.0) <= SETTLED * largest)
            found[settled] = 0.5 * (total + np.swapaxes(total, 1, 2))[settled]
            left &= ~settled & np.isfinite(largest)
            if not left.any():
                break
            power = power @ power
    return found
