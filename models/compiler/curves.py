"""Interpolation: the curve through a measured channel's samples, as a compiled model reads it.

Linear interpolation is too small for a smooth motion: for a sine of the angular frequency w sampled every h, by up to
(w h)^2 / 8 between two samples. Here each piece is the cubic whose slope at a sample is that of the parabola through
the sample and its neighbours (cubic Hermite interpolation, for equal spacing Catmull-Rom's), with an error of third
order.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def read(time: Array, knots: Array, values: Array) -> Array:
    """The curve through `values` (n,) sampled at the rising instants `knots` (n,), at `time` (m,); constant beyond.

    Between two samples of which one is not known (NaN), the curve is NaN; next to these, the slope at a sample is that
    to its other side.
    """
    if len(values) < 2:
        return np.full(len(time), values[0])
    spacing = np.diff(knots)
    chords = np.diff(values) / spacing
    ahead, behind = np.append(chords, np.nan), np.insert(chords, 0, np.nan)
    slopes = np.where(np.isnan(behind), ahead, behind)
    inner = (spacing[1:] * chords[:-1] + spacing[:-1] * chords[1:]) / (spacing[1:] + spacing[:-1])
    slopes[1:-1] = np.where(np.isnan(inner), slopes[1:-1], inner)
    at = np.clip(np.searchsorted(knots, time, "right") - 1, 0, len(spacing) - 1)
    begin, end, chord = slopes[at], slopes[at + 1], chords[at]
    part = np.clip((time - knots[at]) / spacing[at], 0.0, 1.0)
    bent = (begin - chord) * (1.0 - part) - (end - chord) * part
    drawn = values[at] + spacing[at] * part * (chord + (1.0 - part) * bent)
    return np.where(part == 1.0, values[at + 1], np.where(part == 0.0, values[at], drawn))
