"""A gapless stretch of measured data in the shape that a compiled model takes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Segment:
    """n rows of one recording, for a model of nu inputs and ny outputs.

    `time` s, (n,), from the recording's first row on. `inputs` (n, nu) were sampled, or began to be held, at `knots`
    (n, nu) s. `measured` (n, ny), NaN where an output is not known. All C-contiguous float64.
    """

    time: Array
    knots: Array
    inputs: Array
    measured: Array
    source: str = "recording"

    @property
    def duration(self) -> float:
        """s from the first row to the last."""
        return float(self.time[-1] - self.time[0])

    def __len__(self) -> int:
        return len(self.time)
