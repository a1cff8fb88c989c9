"""The strongest line in a signal that comes in little by little: the frequency at which a disturbance would be."""

from __future__ import annotations

import functools
from collections import deque

import numpy as np
from numpy.typing import NDArray
from scipy.fft import next_fast_len, rfft

Array = NDArray[np.float64]

SLOWEST = 0.1
"""Hz, of a line that is looked at."""
LONGEST, SHORTEST = 32.0, 4.0
"""s of the signal that are looked at, at most and at least."""


class LineFinder:
    """Takes whitened innovations (n, ny), a row every `period` s."""

    def __init__(self, period: float) -> None:
        self.period = period
        self._parts: deque[Array] = deque()
        self._rows = 0

    def add(self, rows: Array) -> None:
        """The next rows (n, ny)."""
        self._parts.append(rows)
        self._rows += len(rows)
        while (self._rows - len(self._parts[0])) * self.period > LONGEST:
            self._rows -= len(self._parts.popleft())

    @property
    def span(self) -> float:
        """s that are looked at."""
        return self._rows * self.period

    @property
    def bins(self) -> int:
        """Among how many frequencies the line is picked, at least 1."""
        return max(1, self._rows // 2)

    def frequency(self) -> float | None:
        """Hz of the strongest line, between bins by a parabola through logarithms; None where too little is there."""
        if self.span < SHORTEST:
            return None
        # Zeros are added up to a number that is quick to transform: one with large factors takes ten times as long.
        count = next_fast_len(self._rows, real=True)
        spectrum = rfft(np.concatenate(self._parts) * _window(self._rows), count, axis=0, overwrite_x=True)
        numbers = spectrum.view(np.float64)
        power = np.einsum("fc,fc->f", numbers, numbers)
        span = count * self.period
        first = max(1, int(np.ceil(SLOWEST * span)))
        peak = first + int(np.argmax(power[first:-1]))
        before, there, after = np.log(np.maximum(power[peak - 1 : peak + 2], 1e-300))
        bend = before - 2.0 * there + after
        shift = 0.5 * (before - after) / bend if bend < 0.0 else 0.0
        return float((peak + np.clip(shift, -0.5, 0.5)) / span)


@functools.lru_cache(maxsize=4)
def _window(count: int) -> Array:
    """Hann's, (n, 1)."""
    return np.asarray(np.hanning(count)[:, None])
