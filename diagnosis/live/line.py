"""The strongest spectral line of a signal that comes in little by little: the frequency of a possible disturbance."""

from __future__ import annotations

import functools
from collections import deque

import numpy as np
from numpy.typing import NDArray
from scipy.fft import next_fast_len, rfft
from scipy.special import gammaincc

Array = NDArray[np.float64]

SLOWEST = 0.1
"""Lowest frequency of a line, Hz."""
LONGEST, SHORTEST = 32.0, 4.0
"""Longest and shortest part of the signal that is evaluated, s."""
RECENT = 8.0
"""Last s, evaluated on their own, too: a line that has just begun is weak in the whole, and weakest at a window's
end."""
CHANCE = 0.1
"""Probability of a line as strong as one that is followed, if there is only noise."""


class LineFinder:
    """Takes whitened innovations (n, ny), a sample every `period` s."""

    def __init__(self, period: float) -> None:
        self.period = period
        self._parts: deque[Array] = deque()
        self._rows = 0

    def add(self, rows: Array) -> None:
        """The next samples (n, ny)."""
        self._parts.append(rows)
        self._rows += len(rows)
        while (self._rows - len(self._parts[0])) * self.period > LONGEST:
            self._rows -= len(self._parts.popleft())

    @property
    def bins(self) -> int:
        """Number of frequencies among which the line is picked, at least 1."""
        return max(1, sum(self._lengths()) // 2)

    def frequency(self) -> tuple[float, float] | None:
        """Hz of the strongest line, and the length in s in which it was found; None if noise may be all there is."""
        if self._rows * self.period < SHORTEST:
            return None
        rows = np.concatenate(self._parts)
        power, frequency, span = max(strongest(rows[-length:], self.period) for length in self._lengths())
        # Of white noise in ny outputs, ny times a frequency's power over the mean is gamma distributed, of shape ny.
        outputs = rows.shape[1]
        return (frequency, span) if self.bins * gammaincc(outputs, outputs * power) < CHANCE else None

    def _lengths(self) -> tuple[int, ...]:
        """Samples of all that is evaluated, and of the recent part."""
        recent = int(RECENT / self.period)
        return (self._rows, recent) if recent < self._rows else (self._rows,)


def strongest(rows: Array, period: float) -> tuple[float, float, float]:
    """The strongest line of samples (n, ny), one every `period` s: its power over the mean of all frequencies, its
    frequency in Hz (interpolated between bins by a parabola through logarithms), and the length of the samples in s."""
    # Zero-padded to a length that is quick to transform: one with large prime factors takes ten times as long.
    count = next_fast_len(len(rows), real=True)
    spectrum = rfft(rows * _window(len(rows)), count, axis=0, overwrite_x=True)
    numbers = spectrum.view(np.float64)
    power = np.einsum("fc,fc->f", numbers, numbers)
    span = count * period
    first = max(1, int(np.ceil(SLOWEST * span)))
    peak = first + int(np.argmax(power[first:-1]))
    before, there, after = np.log(np.maximum(power[peak - 1 : peak + 2], 1e-300))
    bend = before - 2.0 * there + after
    shift = 0.5 * (before - after) / bend if bend < 0.0 else 0.0
    frequency = float((peak + np.clip(shift, -0.5, 0.5)) / span)
    return float(power[peak] / max(power[first:-1].mean(), 1e-300)), frequency, len(rows) * period


@functools.lru_cache(maxsize=4)
def _window(count: int) -> Array:
    """A Hann window, (n, 1)."""
    return np.asarray(np.hanning(count)[:, None])
