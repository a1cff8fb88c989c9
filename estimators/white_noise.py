"""How much white noise a channel has, without a model: fourth differences leave hardly anything else."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

Array = NDArray[np.float64]

GAIN_OF_DIFFERENCES = 70.0
"""Variance of fourth differences over that of the white signal: 1 + 16 + 36 + 16 + 1."""
CORRELATION = 12870.0 / 4900.0
"""Rows a degree of freedom of that estimate: the sum of the squared autocorrelations of fourth differences."""
LOSS_OF_MEDIAN = np.pi / 2.0
"""Of degrees of freedom, where the median of blocks is taken and not the mean."""
ROWS = 100
"""Of a block: the median over blocks passes over an impact, which a mean would take for noise."""


def white_variance(parts: Sequence[Array]) -> tuple[Array, float]:
    """Variance of the white noise on each column of `parts` (n, m), by fourth differences, (m,), and its degrees of
    freedom."""
    differences = np.concatenate([np.diff(part, 4, axis=0) for part in parts])
    blocks = np.array_split(differences, max(1, len(differences) // ROWS))
    powers = np.array([np.nanmean(block**2, axis=0) for block in blocks])
    one = len(differences) / len(blocks) / CORRELATION
    variance = np.nanmedian(powers, axis=0) / GAIN_OF_DIFFERENCES / float(chi2.ppf(0.5, one) / one)
    return variance, one * len(blocks) / (LOSS_OF_MEDIAN if len(blocks) > 2 else 1.0)
