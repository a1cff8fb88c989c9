"""The lease on anything that moves: who asked for it must keep saying so, or it ends in order. Pure.

A lease lasts `length` s from each sign of its holder. It is latched: once it is over, however that came, no later sign
brings it back; the holder has to ask again from the beginning. Three ways lead there: the holder lets go (`release`),
its connection goes away (`release`, with that reason), or no sign comes in time (`pass_time`).
"""

from __future__ import annotations

LOOK = 0.05
"""s between two looks at the time that has passed."""


class Lease:
    """Held by `holder`, for `length` s from its last sign. `ended` says why it is over, empty while it holds."""

    def __init__(self, holder: str, length: float) -> None:
        self.holder = holder
        self.length = length
        self.ended = ""
        self.longest = 0.0
        """s, the longest time without a sign so far."""
        self._silence = 0.0

    def renew(self, holder: str) -> bool:
        """A sign of `holder`; False where the lease is not its, or over already."""
        if holder != self.holder or self.ended:
            return False
        self._silence = 0.0
        return True

    def release(self, holder: str, reason: str) -> bool:
        """End the lease for `reason`; False where it is not this holder's, or over already."""
        if holder != self.holder or self.ended:
            return False
        self.ended = reason
        return True

    def pass_time(self, elapsed: float) -> bool:
        """`elapsed` s have passed without a sign; whether the lease holds still.

        Of one long step two looks count: a process that was held up itself has not read the signs that wait for it.
        """
        self._silence += min(elapsed, 2.0 * LOOK)
        if not self.ended:
            self.longest = max(self.longest, self._silence)
        if not self.ended and self._silence > self.length:
            self.ended = f"{self.holder} has given no sign for {1e3 * self.length:.0f} ms"
        return not self.ended
