"""Quantised outputs, as of an encoder or of rounded numbers, and the noise of a quantiser.

    std = step / sqrt(12)

is the rounding error of a reading that changes by more than a `step` between samples: uniform, and independent from
sample to sample (Widrow, Kollar, "Quantization noise", 2008, chapter 4). While the axis hardly moves it is neither: the
same error persists for many samples, and while the axis is at rest there is no scatter at all. So the noise of such a
channel is computed from its step, and never assumed smaller, however quiet a record is.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from upright.telemetry.recording import Recording

Array = NDArray[np.float64]

EVEN = 0.02
"""Share of a step by which readings may be off the grid, because text files round them."""
FEWEST = 10
"""Fewest distinct values: three may be multiples of anything by chance."""


def step_of(values: Array) -> float:
    """The quantisation step of `values` (n,); 0 if they are not quantised.

    It is the smallest difference between two distinct values, if all others are multiples of it. Numbers from a text
    file are quantised to its last decimal, which is far below the noise of most sensors.
    """
    known = values[np.isfinite(values)]
    distinct = np.unique(known)
    if len(distinct) < FEWEST:
        return 0.0
    apart = np.diff(distinct)
    step = float(np.min(apart[apart > 1e-9 * np.ptp(distinct)], initial=np.inf))
    if not math.isfinite(step):
        return 0.0
    # The smallest difference has a rounding error; the mean of all single steps has not.
    step = float(np.mean(apart[np.abs(apart / step - 1.0) < 0.5]))
    off = np.abs(apart / step - np.round(apart / step))
    return step if float(np.max(off)) < EVEN else 0.0


def quantisation_noise(name: str, recordings: Sequence[Recording]) -> float:
    """Standard deviation of the quantisation noise of channel `name`, the largest of `recordings`."""
    steps = [step_of(each[name]) for each in recordings if name in each.values]
    return max(steps, default=0.0) / math.sqrt(12.0)
