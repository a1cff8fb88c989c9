"""The only clock in the pure layers: how long a fit took. It sets `Estimate.seconds`; no estimate depends on it."""

from __future__ import annotations

from time import perf_counter


def stopwatch() -> float:
    """s since an arbitrary instant."""
    return perf_counter()
