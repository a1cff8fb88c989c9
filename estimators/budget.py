"""How long a piece of work may take: whoever computes asks now and then whether the time is over.

A fit that is cut off is one that failed (an ArithmeticError), as one that diverges is, so that a search goes on with
those that ended. Nothing that is computed depends on the clock but what was left untried, and that is said.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from estimators.stopwatch import stopwatch


class OutOfTime(ArithmeticError):
    """The time is over before the work is."""


@dataclass(frozen=True, slots=True)
class Budget:
    """Work that may take until `ends`, s of estimators.stopwatch."""

    ends: float = math.inf

    @classmethod
    def of(cls, seconds: float | None) -> Budget:
        """From now on; None for as long as it takes."""
        return cls() if seconds is None else cls(stopwatch() + seconds)

    @property
    def left(self) -> float:
        """s, 0 where the time is over."""
        return max(0.0, self.ends - stopwatch())

    def part(self, share: float) -> Budget:
        """A share of what is left, 0 to 1."""
        return Budget() if math.isinf(self.ends) else Budget(stopwatch() + share * self.left)

    def check(self) -> None:
        """Raises OutOfTime."""
        if stopwatch() > self.ends:
            raise OutOfTime("the time for it was over")


UNLIMITED = Budget()
