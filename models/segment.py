"""A gapless segment of measured data in the form that a compiled model takes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Segment:
    """n samples of one recording, for a model of nu inputs and ny outputs.

    `time` s, (n,), since the recording's first sample. `inputs` (m, nu) were sampled, or began to be held, at `knots`
    (m, nu) s: one per sample, and before them m - n earlier ones, for a delayed input. `measured` (n, ny), NaN if an
    output is not known. All C-contiguous float64.
    """

    time: Array
    knots: Array
    inputs: Array
    measured: Array
    source: str = "recording"

    @property
    def duration(self) -> float:
        """s from the first sample to the last."""
        return float(self.time[-1] - self.time[0])

    @property
    def earlier(self) -> int:
        """Number of input samples before that of the first sample."""
        return len(self.inputs) - len(self.time)

    @property
    def row_inputs(self) -> Array:
        """Those of `inputs` that belong to the n samples, (n, nu), not copied."""
        return self.inputs[self.earlier :]

    @property
    def row_knots(self) -> Array:
        """Those of `knots` that belong to the n samples, (n, nu), not copied."""
        return self.knots[self.earlier :]

    def __len__(self) -> int:
        return len(self.time)
