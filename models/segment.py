"""A gapless stretch of measured data in the shape that a compiled model takes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Segment:
    """n rows of one recording, for a model of nu inputs and ny outputs.

    `time` s, (n,), from the recording's first row on. `inputs` (m, nu) were sampled, or began to be held, at `knots`
    (m, nu) s: one a row, and before them m - n that came earlier, for an input that acts late. `measured` (n, ny), NaN
    where an output is not known. All C-contiguous float64.
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

    @property
    def earlier(self) -> int:
        """How many samples of the inputs came before those of the first row."""
        return len(self.inputs) - len(self.time)

    @property
    def row_inputs(self) -> Array:
        """Those of `inputs` that belong to the rows, (n, nu), where they are."""
        return self.inputs[self.earlier :]

    @property
    def row_knots(self) -> Array:
        """Those of `knots` that belong to the rows, (n, nu), where they are."""
        return self.knots[self.earlier :]

    def __len__(self) -> int:
        return len(self.time)
