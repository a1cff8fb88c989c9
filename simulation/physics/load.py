"""What somebody does to a virtual vehicle: a load that is put on and taken off again, a tilt by hand, and switching the
flywheels.

Load and tilt are a torque about the axis that the vehicle falls about.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import cos, pi


@dataclass(frozen=True, slots=True)
class Load:
    """`torque` (N m, with the sign of the angle it acts on), reached as a ramp of `ramp` s, above 0."""

    torque: float
    ramp: float


@dataclass(frozen=True, slots=True)
class Tilt:
    """Over to the other side by hand within `duration` s, as far as the vehicle leans now; then it is let go."""

    duration: float


@dataclass(frozen=True, slots=True)
class Spin:
    """The flywheels' inverters are switched on (`up`) or off; they stay so."""

    up: bool


Action = Load | Tilt | Spin
"""What somebody does."""


HAND = 2.0 * pi * 1.5
"""1/s, natural frequency of a vehicle in a hand that holds it: people move things at up to some 2 Hz."""
HOLD = 3.0
"""How much stiffer than that it is held, so that the weight of a vehicle that wants to fall does not win."""
LET_GO = 0.5
"""s that the hand stays after the movement."""


class LoadTorque:
    """The torque of what is on the vehicle, of `inertia` kg m^2, once per integration step of `step` s."""

    __slots__ = ("_elapsed", "_from", "_inertia", "_per_step", "_step", "_target", "_tilt", "_torque")

    def __init__(self, step: float, inertia: float) -> None:
        self._step, self._inertia = step, inertia
        self._torque = self._target = self._per_step = 0.0
        self._tilt: Tilt | None = None
        self._elapsed = 0.0
        self._from = 0.0

    def carry(self, load: Load | Tilt | None) -> None:
        """Put `load` on from now on, in place of the one that is there; None takes that off as fast as it came."""
        self._tilt = load if isinstance(load, Tilt) else None
        self._elapsed = 0.0
        self._target = load.torque if isinstance(load, Load) else 0.0
        if isinstance(load, Load):
            self._per_step = abs(load.torque - self._torque) * self._step / load.ramp

    def torque(self, angle: float, rate: float) -> float:
        """N m over this step; the vehicle leans by `angle` rad and falls at `rate` rad/s."""
        if self._tilt is not None:
            return self._by_hand(self._tilt, angle, rate)
        missing = self._target - self._torque
        self._torque += max(-self._per_step, min(self._per_step, missing))
        return self._torque

    def _by_hand(self, tilt: Tilt, angle: float, rate: float) -> float:
        """A hand holds the vehicle as a spring with a damper, and moves it along half a cosine."""
        if self._elapsed == 0.0:
            self._from = angle
        self._elapsed += self._step
        if self._elapsed >= tilt.duration + LET_GO:
            return 0.0
        wanted = self._from * cos(pi * min(self._elapsed / tilt.duration, 1.0))
        return self._inertia * (HAND * HAND * HOLD * (wanted - angle) - 2.0 * HAND * HOLD * rate)
