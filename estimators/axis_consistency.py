"""Do position and rate of an axis tell of the same motion?

The change of the position and the integral of the rate differ by the resolution of the one and the filter of the
other, which do not add up, and by an error of scale. What is beyond that is added up and forgotten at the rate of that
error (a CUSUM: Page, Biometrika 41 (1954) 100).
"""

from __future__ import annotations

SCALE = 0.1
"""Share by which rate and position may differ for ever: an error of units, which is an effect to be diagnosed."""


class AxisConsistency:
    """Pass every cycle to `update`, which returns by how much the two differ, in the unit of the position."""

    __slots__ = ("_back", "_forth", "_position")

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Begin again: the next position is the first."""
        self._position = float("nan")
        self._forth = self._back = 0.0

    def update(self, dt: float, position: float, rate: float) -> float:
        """`dt` s later; not a number at either begins again."""
        turned = rate * dt
        error = position - self._position - turned
        self._position = position
        if error != error:
            self._forth = self._back = 0.0
            return 0.0
        forgiven = SCALE * abs(turned)
        self._forth = max(0.0, self._forth + error - forgiven)
        self._back = max(0.0, self._back - error - forgiven)
        return max(self._forth, self._back)
