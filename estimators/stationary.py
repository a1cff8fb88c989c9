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
    """X = A X A' + Q (nx, nx), by doubling: Q + A Q A', then twice as many rows, and so on.

    A state that decays slowly or not at all, and that nothing drives, does no harm, as it would to a linear system for
    all of X at once. Source: Smith, SIAM J. Applied Mathematics 16 (1968) 198. Raises EstimationError where X grows for
    ever.
    """
    total, power = driven, transition
    with np.errstate(over="ignore", invalid="ignore"):
        for _ in range(DOUBLINGS):
            more = power @ total @ power.T
            total = total + more
            if not np.isfinite(total).all():
                break
            if np.max(np.abs(more)) <= SETTLED * np.max(np.abs(total)):
                return np.asarray(0.5 * (total + total.T))
            power = power @ power
    raise EstimationError(
        "predictor", "its errors grow for ever", remedy="check the values and the noises of the model."
    )
