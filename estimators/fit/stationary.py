"""The covariance that noise gives a stable system in the long run."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from estimators.contract import EstimationError

Array = NDArray[np.float64]

DOUBLINGS = 60
"""After these a state has had more time than any record."""
SETTLED = 1e-13
"""Share of the covariance that one more doubling may add."""


def stationary(transition: Array, driven: Array) -> Array:
    """X = A X A' + Q (nx, nx), of one system (in_the_long_run). Raises EstimationError where X grows for ever."""
    found = np.asarray(in_the_long_run(transition[None], driven[None])[0])
    if np.isfinite(found).all():
        return found
    raise EstimationError(
        "predictor", "its errors grow for ever", remedy="check the values and the noises of the model."
    )


def in_the_long_run(transition: Array, driven: Array) -> Array:
    """X = A X A' + Q (n, nx, nx), by doubling: Q + A Q A', then twice as many rows, and so on; NaN where X grows for
    ever.

    A state that decays slowly or not at all, and that nothing drives, does no harm, as it would to a linear system for
    all of X at once. Source: Smith, SIAM J. Applied Mathematics 16 (1968) 198.
    """
    found = np.full(driven.shape, np.nan)
    total, power, left = driven, transition, np.arange(len(driven))
    with np.errstate(over="ignore", invalid="ignore"):
        for _ in range(DOUBLINGS):
            if not len(left):
                break
            more = power @ total @ np.swapaxes(power, 1, 2)
            total = total + more
            settled = np.abs(more).max(axis=(1, 2)) <= SETTLED * np.abs(total).max(axis=(1, 2))
            found[left[settled]] = 0.5 * (total + np.swapaxes(total, 1, 2))[settled]
            on = np.isfinite(total).all(axis=(1, 2)) & ~settled
            if not on.all():
                left, total, power = left[on], total[on], power[on]
            power = power @ power
    return found
