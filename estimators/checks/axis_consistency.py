"""Do position and rate of an axis tell of the same motion?

The change of the position and the integral of the rate differ by the resolution of the one and the filter of the
other, which do not add up, and by an error of scale. The difference is added up, and forgotten at the rate of that
error. An interval that is not a period says nothing: a frame was lost or late.
"""

from __future__ import annotations

from math import copysign

SCALE = 0.1
"""Share by which rate and position may differ for ever: an error of units, which is an effect to be diagnosed."""


class AxisConsistency:
    """Pass every answer of a drive to `update`. It returns by how much the two differ, in the unit of the position."""

    __slots__ = ("_difference", "_position", "_rate")

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Begin again: the next position is the first."""
        self._position = self._rate = float("nan")
        self._difference = 0.0

    def update(self, dt: float, period: float, position: float, rate: float) -> float:
        """`dt` s later, where `period` s are usual; not a number at either begins again."""
        turned = 0.5 * (self._rate + rate) * dt
        error = position - self._position - turned
        self._position, self._rate = position, rate
        if error != error:
            self._difference = 0.0
        elif 0.5 * period <= dt <= 1.5 * period:
            found = self._difference + error
            self._difference = copysign(max(0.0, abs(found) - SCALE * abs(turned)), found)
        return abs(self._difference)
