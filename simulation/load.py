"""A load that somebody puts on a virtual vehicle and takes off again: a torque about the axis it falls about."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Load:
    """`torque` (N m, with the sign of the angle it acts on), reached as a ramp of `ramp` s, above 0."""

    torque: float
    ramp: float


class LoadTorque:
    """The torque of the load that is on the vehicle, once per integration step of `step` s."""

    __slots__ = ("_per_step", "_step", "_target", "_torque")

    def __init__(self, step: float) -> None:
        self._step = step
        self._torque = self._target = self._per_step = 0.0

    def carry(self, load: Load | None) -> None:
        """Put `load` on from now on, in place of the one that is there; None takes that off as fast as it came."""
        self._target = load.torque if load is not None else 0.0
        if load is not None:
            self._per_step = abs(load.torque - self._torque) * self._step / load.ramp

    def torque(self) -> float:
        """N m over this step."""
        missing = self._target - self._torque
        self._torque += max(-self._per_step, min(self._per_step, missing))
        return self._torque
