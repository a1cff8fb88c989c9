"""Histograms of the control loop's times, in s: how regular, how quick, and how late its cycles are.

    interval     from one IMU frame set to the next, by the data's clock
    processing   of one wake-up in which a cycle was answered, by this computer's clock
    turnaround   from the kernel's receive time of a frame set until its setpoints have been given to the bus

Buckets are fixed and made beforehand: a value costs one bisection and one increment. A count is of the values up to the
bucket's upper bound, inclusive, that no smaller bucket has; the last count is of those beyond all bounds. Nothing here
reads a clock.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Sequence
from typing import Any

INTERVALS = (0.5, 0.8, 0.9, 0.95, 0.98, 0.99, 1.01, 1.02, 1.05, 1.1, 1.2, 1.5, 2.0, 3.0, 5.0, 10.0)
"""Bounds of the interval in periods. Beyond 1.5 a cycle was missed."""

TIMES = tuple(digit * 10.0**power for power in (-5, -4, -3, -2, -1) for digit in (1, 2, 3, 5, 7))
"""Bounds of the other two, s: 10 us to 0.7 s."""


class Histogram:
    """Counts of values in the buckets up to each of `bounds`, which ascend, and beyond; their sum and the largest."""

    __slots__ = ("bounds", "counts", "largest", "total")

    def __init__(self, bounds: Sequence[float]) -> None:
        self.bounds = tuple(bounds)
        self.counts = [0] * (len(self.bounds) + 1)
        self.total = 0.0
        self.largest = 0.0

    def add(self, value: float) -> None:
        """Count one value."""
        self.counts[bisect_left(self.bounds, value)] += 1
        self.total += value
        if value > self.largest:
            self.largest = value

    def to_json(self) -> dict[str, Any]:
        """`bounds` and `counts` (one more than bounds), `sum` and `largest` of all values."""
        return {"bounds": self.bounds, "counts": tuple(self.counts), "sum": self.total, "largest": self.largest}


class Timing:
    """The histograms of a loop with this `period`, s."""

    __slots__ = ("interval", "processing", "turnaround")

    def __init__(self, period: float) -> None:
        self.interval = Histogram([round(period * share, 9) for share in INTERVALS])
        self.processing = Histogram(TIMES)
        self.turnaround = Histogram(TIMES)

    def to_json(self) -> dict[str, Any]:
        """The three, by name."""
        return {name: getattr(self, name).to_json() for name in ("interval", "processing", "turnaround")}
