"""The one clock in the pure layers: how long a fit took. It feeds `Estimate.seconds` and nothing that is estimated."""

from __future__ import annotations

from time import perf_counter


def stopwatch() -> float:
    """s from some instant on."""
    return perf_counter()
