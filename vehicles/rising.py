"""Getting up by the balancing controller alone: whether the vehicle is up, and whether that takes too long."""

from __future__ import annotations

from dataclasses import dataclass
from math import copysign, degrees

from upright.vehicles.contract import Lean


@dataclass(frozen=True, slots=True)
class Upright:
    """A vehicle is up once |angle| < `angle` (rad) and |rate| < `rate` (rad/s) for `time` s; a rise that takes longer
    than `timeout` s has failed."""

    angle: float
    rate: float
    time: float
    timeout: float


class Rising:
    """One rise. `side` is that of the support on which it begins, 1.0 or -1.0; 0.0 before the first cycle."""

    def __init__(self, upright: Upright, what: str, causes: str) -> None:
        """`what` rises, and the possible `causes` of a failure: words of `failure`."""
        self.side = 0.0
        self.risen = False
        self.failure = ""
        self._wanted = upright
        self._what, self._causes = what, causes
        self._elapsed = 0.0
        self._upright = 0.0

    def step(self, dt: float, lean: Lean) -> None:
        """One control cycle of `dt` s."""
        wanted = self._wanted
        if self.side == 0.0:
            self.side = copysign(1.0, lean.angle)
        self._elapsed += dt
        up = abs(lean.angle) < wanted.angle and abs(lean.rate) < wanted.rate
        self._upright = self._upright + dt if up else 0.0
        self.risen = self._upright >= wanted.time
        if not self.risen and self._elapsed > wanted.timeout:
            self.failure = (
                f"the {self._what} was not upright within {wanted.timeout:g} s (tilt {degrees(lean.angle):.1f} deg): "
                f"{self._causes}"
            )
