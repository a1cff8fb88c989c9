"""White noise of a channel, estimated without a model: fourth differences suppress almost everything else."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from upright.estimators.tails import chi2_ppf

Array = NDArray[np.float64]

GAIN_OF_DIFFERENCES = 70.0
"""Variance of the fourth differences of white noise divided by its own: 1 + 16 + 36 + 16 + 1."""
CORRELATION = 12870.0 / 4900.0
"""Samples per degree of freedom of that estimate: the sum of the squared autocorrelations of fourth differences."""
SKEWNESS = 2704156.0 / 900900.0
"""Samples per degree of freedom of the chi-squared distribution that has the same median as the mean square of a few
fourth differences. The median differs from the mean by the ratio of the third moment to the second, C(24, 12) / 70^3
over C(16, 8) / 70^2 (Cornish and Fisher)."""
LOSS_OF_MEDIAN = np.pi / 2.0
"""Factor by which the median of blocks has fewer degrees of freedom than the mean."""
ROWS = 25
"""Samples per block. The median over blocks ignores impacts, which a mean would include in the noise. Gear backlash
causes an impact whenever the motor reverses: with 100 samples, 0.5 s, hardly a block was free of impacts, and the noise
was estimated eight times too large."""


def differences(signal: Array) -> Array:
    """Fourth differences of `signal` (n, ...), (n - 4, ...)."""
    return np.asarray(np.diff(signal, 4, axis=0))


def white_variance(parts: Sequence[Array]) -> tuple[Array, float]:
    """Variance of the white noise on each column of `parts` (n, m), from fourth differences, (m,), and its degrees of
    freedom; not a number, and 0, if no part has five samples."""
    rough = np.concatenate([differences(part) for part in parts])
    if not len(rough):
        return np.full(rough.shape[1], np.nan), 0.0
    blocks = max(1, len(rough) // ROWS)
    longer = len(rough) % blocks  # the first blocks, so many, have one sample more than the others
    begins = np.arange(blocks) * (len(rough) // blocks) + np.minimum(np.arange(blocks), longer)
    known = np.isfinite(rough)
    sums = np.add.reduceat(np.where(known, rough, 0.0) ** 2, begins)
    counts = np.add.reduceat(known.astype(np.int64), begins)
    powers = np.where(counts > 0, sums / np.maximum(counts, 1), np.nan)  # a block may be unknown as a whole
    rows = len(rough) / blocks
    median = float(chi2_ppf(0.5, rows / SKEWNESS) / (rows / SKEWNESS))
    variance = np.nanmedian(powers, axis=0) / GAIN_OF_DIFFERENCES / median
    return variance, len(rough) / CORRELATION / (LOSS_OF_MEDIAN if blocks > 2 else 1.0)
