"""Numbers for people: as many digits as the standard deviation justifies."""

from __future__ import annotations

import math

import numpy as np


def significant(std: float) -> int:
    """Decimals with which a value of this standard deviation is written: two digits of the deviation."""
    if not 0.0 < std < np.inf:
        return 3
    return int(np.clip(1 - np.floor(np.log10(std)), 0, 12))


def with_error(value: float, std: float) -> str:
    """`8.1 ± 0.4`: two digits of the standard deviation if its first digit is 1, otherwise one, and as many decimals of
    the value."""
    if not (math.isfinite(std) and std > 0.0):
        return f"{value:.3g}"
    first = math.floor(math.log10(std))
    places = -first + (1 if std / 10.0**first < 2.0 else 0)
    if places < 0:
        scale = 10.0**-places
        return f"{round(value / scale) * scale:.0f} ± {round(std / scale) * scale:.0f}"
    return f"{value:.{places}f} ± {std:.{places}f}"
