"""Does a sensor repeat itself as no sensor with noise does?

How often a reading is the same as the one before depends on resolution and noise, so it is learned. With `same` of
`pairs` seen before, the chance of n repeats in a row is that of Polya's urn,

    product over k < n of  (1 + same + k) / (1 + fresh + pairs + k)

where `fresh` readings that differ are what is known of the sensor before it is seen. Without any, a sensor so coarse
that it has always read the same may go on so.
"""

from __future__ import annotations

from math import log

BEYOND_CHANCE = log(1e9)
"""Log-odds: chance repeats one axis at 500 Hz for so long once in 500 h."""
REMEMBERED = 4096
"""Pairs of readings after which the older ones count half."""


class Repeats:
    """Pass to `update` whether a reading is the same as the one before."""

    __slots__ = ("_evidence", "_fresh", "_pairs", "_run", "_same")

    def __init__(self, fresh: int) -> None:
        self._fresh = fresh
        self._pairs = self._same = self._run = 0
        self._evidence = 0.0

    @property
    def stuck(self) -> bool:
        """Whether chance does not explain how often it has repeated itself up to now."""
        return self._evidence > BEYOND_CHANCE

    def update(self, same: bool) -> None:
        """One reading more."""
        if same:
            known = 1 + self._run
            self._evidence += log((known + self._fresh + self._pairs) / (known + self._same))
            self._run = known
        else:
            self._pairs += 1
            self.begin()

    def begin(self) -> None:
        """The next reading does not follow the last one. A run of repeats that chance explains is known now; one that
        it does not explain was no measurement, and teaches nothing."""
        if not self.stuck:
            self._pairs += self._run
            self._same += self._run
        self._run, self._evidence = 0, 0.0
        if self._pairs > REMEMBERED:
            self._pairs //= 2
            self._same //= 2
