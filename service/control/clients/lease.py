"""The lease on an experiment: its holder must renew it, or the experiment ends in order. Pure.

A lease lasts `length` s from each renewal by its holder. It is latched: once it has ended, it cannot be renewed any
more, and the holder has to start again. It ends in three ways: the holder releases it (`release`), the holder
disconnects (`release`, with that reason), or it is not renewed in time (`pass_time`).
"""

from __future__ import annotations

LOOK = 0.05
"""s between two checks of the elapsed time."""


class Lease:
    """Held by `holder`, for `length` s from the last renewal. `ended` is the reason of its end, empty before."""

    def __init__(self, holder: str, length: float) -> None:
        self.holder = holder
        self.length = length
        self.ended = ""
        self.longest = 0.0
        """s, the longest time without a renewal so far."""
        self._silence = 0.0

    def renew(self, holder: str) -> bool:
        """Renew the lease; False if it is not held by `holder`, or has ended."""
        if holder != self.holder or self.ended:
            return False
        self._silence = 0.0
        return True

    def release(self, holder: str, reason: str) -> bool:
        """End the lease for `reason`; False if it is not held by `holder`, or has ended."""
        if holder != self.holder or self.ended:
            return False
        self.ended = reason
        return True

    def pass_time(self, elapsed: float) -> bool:
        """Count `elapsed` s without a renewal; return whether the lease is still valid.

        A step counts as two check periods at most: if this process was delayed, it has not yet read the renewals that
        are waiting.
        """
        self._silence += min(elapsed, 2.0 * LOOK)
        if not self.ended:
            self.longest = max(self.longest, self._silence)
        if not self.ended and self._silence > self.length:
            self.ended = f"{self.holder} has not renewed the lease for {1e3 * self.length:.0f} ms"
        return not self.ended
