"""A command that follows its target by no more than so much per second, as that of a drive with a ramp."""

from __future__ import annotations

from math import copysign, isfinite


class RampLimiter:
    """Follows held targets by no more than `ramp` unit/s, from `target` on."""

    __slots__ = ("_demand", "_ramp")

    def __init__(self, ramp: float, target: float) -> None:
        self._ramp, self._demand = ramp, target

    def step(self, target: float, span: float) -> float:
        """Output minus `target`, as a mean over the next `span` s. It is 0 for a target that is not known; the limiter
        restarts after it."""
        change = target - self._demand
        if not isfinite(change):
            self._demand = target
            return 0.0
        needed = abs(change) / self._ramp
        if needed <= span:
            self._demand = target
            return -change * needed / (2.0 * span)
        moved = copysign(self._ramp * span, change)
        self._demand += moved
        return 0.5 * moved - change
