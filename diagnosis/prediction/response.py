"""Gain and phase of a measured signal over a simulated one, octave by octave.

    measured(f) = response simulated(f) + noise(f),   response = sum of measured conj(simulated) / sum of |simulated|^2

over the lines of an octave: 1 where the simulation responds as the vehicle does. Its deviation follows from what is
left in the octave, so that a disturbance which the simulation does not contain makes it less certain, and not wrong.
The lines are those of the record's length, without a window: an excitation that begins and ends at rest needs none.
Source: Pintelon and Schoukens, System Identification, 2nd ed., section 2.4 (least squares over neighbouring lines).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import degrees, log2, sqrt
from typing import Any

import numpy as np
from numpy.typing import NDArray

from upright.estimators.tails import f_sf

Array = NDArray[np.float64]

FEWEST = 4
"""Lines of an octave from which noise and response can be told apart."""
EXCITED = 1e-3
"""Least power of a line on average, over that of the octave with most: below it there is the leakage of others only."""


@dataclass(frozen=True, slots=True)
class Band:
    """The response between `begin` and `end` Hz, with the standard deviation of its real and of its imaginary part.
    `chance`: probability of a difference from 1 as large as this by noise alone."""

    begin: float
    end: float
    response: complex
    std: float
    chance: float

    def to_json(self) -> dict[str, Any]:
        gain, turned = abs(self.response), degrees(float(np.angle(self.response)))
        return {
            "from": self.begin,
            "to": self.end,
            "gain": gain,
            "gain_std": self.std,
            "phase_deg": turned,
            "phase_std_deg": degrees(self.std / gain) if gain else None,
            "chance": self.chance,
        }


def responses(measured: Sequence[Array], simulated: Sequence[Array], period: float) -> list[Band]:
    """The octaves that are excited, from several records of signals, (m,) each, sampled every
    `period` s."""
    lines = [
        _lines(one, other, period) for one, other in zip(measured, simulated, strict=True) if len(one) > 2 * FEWEST
    ]
    if not lines:
        return []
    frequency, over, under = (np.concatenate(each) for each in zip(*lines, strict=True))
    lowest = float(np.min(frequency))
    octave = np.floor(np.log2(frequency / lowest) + 1e-9).astype(int)
    rows_of: list[NDArray[np.bool_]] = []
    for number in range(int(log2(float(np.max(frequency)) / lowest)) + 1):
        rows = octave == number
        if np.count_nonzero(rows) >= FEWEST:
            rows_of.append(rows)
    power = [float(np.mean(np.abs(under[rows]) ** 2)) for rows in rows_of]
    return [
        _band(lowest * 2.0 ** float(octave[rows][0]), over[rows], under[rows])
        for rows, each in zip(rows_of, power, strict=True)
        if each > EXCITED * max(power)
    ]


def _lines(
    measured: Array, simulated: Array, period: float
) -> tuple[Array, NDArray[np.complex128], NDArray[np.complex128]]:
    known = np.isfinite(measured) & np.isfinite(simulated)
    one, other = (np.where(known, signal, 0.0) for signal in (measured, simulated))
    spectra = (np.fft.rfft(signal - np.mean(signal))[1:] for signal in (one, other))
    return (np.fft.rfftfreq(len(measured), period)[1:], *spectra)  # type: ignore[return-value]


def _band(begin: float, measured: NDArray[np.complex128], simulated: NDArray[np.complex128]) -> Band:
    power, count = float(np.sum(np.abs(simulated) ** 2)), len(measured)
    response = complex(np.sum(measured * np.conj(simulated)) / power)
    left = float(np.sum(np.abs(measured - response * simulated) ** 2)) / (2 * (count - 1))
    variance = left / power
    ratio = abs(response - 1.0) ** 2 / (2.0 * variance) if variance else float("inf")
    return Band(begin, 2.0 * begin, response, sqrt(variance), float(f_sf(ratio, 2, 2 * (count - 1))))
