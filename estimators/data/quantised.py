"""Outputs that a record shows in steps, as an encoder or rounded numbers do, and the noise that a quantiser makes.

    std = step / sqrt(12)

is what rounding to `step` leaves of a reading that moves by more than a step between rows: uniform, and independent
from row to row (Widrow, Kollar, "Quantization noise", 2008, chapter 4). While the axis hardly moves it is neither: the
same error stays for many rows, and where the axis rests no scatter is left at all. So the noise of such a channel is
known from its steps, and never taken for less, however quiet a record is.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from telemetry.recording import Recording

Array = NDArray[np.float64]

EVEN = 0.02
"""Share of a step by which readings may be off the grid of the steps: what text has rounded away."""
FEWEST = 10
"""Values that have to occur: three may be multiples of anything."""


def step_of(values: Array) -> float:
    """The step in which `values` (n,) count; 0 where they do not.

    It is the smallest between two that occur, if all others are multiples of it. Numbers that were written with so many
    decimals count in these, which is far below the noise of most sensors.
    """
    known = values[np.isfinite(values)]
    distinct = np.unique(known)
    if len(distinct) < FEWEST:
        return 0.0
    apart = np.diff(distinct)
    step = float(np.min(apart[apart > 1e-9 * np.ptp(distinct)], initial=np.inf))
    if not math.isfinite(step):
        return 0.0
    # The smallest is off by what was rounded; the mean of all single steps is not.
    step = float(np.mean(apart[np.abs(apart / step - 1.0) < 0.5]))
    off = np.abs(apart / step - np.round(apart / step))
    return step if float(np.max(off)) < EVEN else 0.0


def quantisation_noise(name: str, recordings: Sequence[Recording]) -> float:
    """Standard deviation of what counting in steps adds to channel `name`, the largest of `recordings`."""
    steps = [step_of(each[name]) for each in recordings if name in each.values]
    return max(steps, default=0.0) / math.sqrt(12.0)
