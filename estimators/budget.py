"""Time budget of a computation, which checks now and then whether its time is up.

A fit that is cut off has failed (an ArithmeticError), as one that diverges has, so that a search continues with the
fits that finished. The clock has no influence on computed values, only on which candidates remain untried, and these
are reported.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from upright.estimators.stopwatch import stopwatch


class OutOfTime(ArithmeticError):
    """The time was up before the computation finished."""


@dataclass(frozen=True, slots=True)
class Budget:
    """A computation that may take until `ends`, s of estimators.stopwatch."""

    ends: float = math.inf

    @classmethod
    def of(cls, seconds: float | None) -> Budget:
        """`seconds` from now; None for no limit."""
        return cls() if seconds is None else cls(stopwatch() + seconds)

    @property
    def left(self) -> float:
        """Remaining time, s; 0 if the time is up."""
        return max(0.0, self.ends - stopwatch())

    def part(self, share: float) -> Budget:
        """A share (0 to 1) of the remaining time."""
        return Budget() if math.isinf(self.ends) else Budget(stopwatch() + share * self.left)

    def check(self) -> None:
        """Raises OutOfTime if the time is up."""
        if stopwatch() > self.ends:
            raise OutOfTime("its time was up")


UNLIMITED = Budget()
