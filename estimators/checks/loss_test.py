"""Does a bus lose more than a running bus may?

A sequential test (Wald 1945; as CUSUM: Page, Biometrika 41 (1954) 100) between two shares of lost cycles: `USUAL`, and
every second one. The second is decided for as soon as the log-likelihood ratio exceeds `THRESHOLD`: after some twenty
cycles, where a count of losses in a row would wait for chance.
"""

from __future__ import annotations

from math import log

USUAL = 0.06
"""Share of the cycles in which something is lost on a bus that loses 1 % of its frames: three of the IMU, SYNC,
setpoint and answer."""
HEAVY = 0.5
"""Share of lost cycles that no controller was designed for."""
THRESHOLD = log(1e9)
"""Log-likelihood ratio that a bus with `USUAL` losses exceeds once in more than 1e9 cycles, 1,100 h at 250 Hz."""

IN_A_ROW = 3
"""Lost cycles in a row that count where a longer interruption has a limit of its own: it is one event, not a share."""

_LOST = log(HEAVY / USUAL)
_KEPT = log((1.0 - HEAVY) / (1.0 - USUAL))


class LossTest:
    """Count every cycle. `log_ratio` is the log-likelihood ratio of `HEAVY` against `USUAL` losses, 0 or more; of
    lost cycles in a row, `in_a_row` count."""

    __slots__ = ("_counted", "_in_a_row", "_row", "log_ratio")

    def __init__(self, in_a_row: int = IN_A_ROW) -> None:
        self._in_a_row = in_a_row
        self.reset()

    def reset(self) -> None:
        """Forget what was lost."""
        self.log_ratio = 0.0
        self._row = self._counted = 0

    def came(self, missed: int = 0) -> None:
        """A cycle that was not lost, after `missed` ones that were; -1: one more in the same cycle, so that one of
        those that were missed before was late and not lost."""
        if missed < 0:
            if self._counted:
                self._counted -= 1
                self.log_ratio = max(0.0, self.log_ratio - _LOST)
            return
        counted = min(missed, self._in_a_row)
        self._counted = min(self._row, self._in_a_row) + counted
        self._row = 0
        self.log_ratio = max(0.0, self.log_ratio + counted * _LOST + _KEPT)

    def lost(self) -> None:
        """A cycle that was lost."""
        self._row += 1
        if self._row <= self._in_a_row:
            self.log_ratio += _LOST
