"""Friction with memory: bristles that bend before they slide, and yielding material. Torques in N m on the roll axis.

LuGre (Canudas de Wit et al., IEEE TAC 40, 1995):  z' = v - stiffness |v| z / g(v),  torque = -stiffness z - damping z',
with g the torque at which the bristles slide; their equation is integrated implicitly, so it is stable at any speed.
Bouc-Wen (Wen, J. Eng. Mech. 102, 1976):  z' = (v / yield) (1 - |z|^n (1 + sgn(v z)) / 2),  torque = -size z.
"""

from __future__ import annotations

import math
from typing import Protocol

BRISTLE_DEFLECTION = 1.0e-4
"""rad of roll at which the bristles begin to slide."""
BRISTLE_DAMPING = 0.03
"""s, damping over stiffness of the bristles."""
STRIBECK_RATE = 0.01
"""rad/s at which most of the breakaway torque is gone."""


class Rolling(Protocol):
    """The quantities of a vehicle that friction on the roll axis depends on: rad/s, N m, and s per step."""

    @property
    def roll_rate(self) -> float: ...
    @property
    def gyroscopic_torque(self) -> float: ...
    @property
    def step_size(self) -> float: ...


class LuGreFriction:
    """Bristle friction that begins to slide at `deflection` rad, at `level` N m; `damping` (s) as above."""

    def __init__(self, size: float, deflection: float = BRISTLE_DEFLECTION, damping: float = BRISTLE_DAMPING) -> None:
        self._size = size
        self._stiffness = abs(size) / deflection
        self._damping = damping
        self._deflection = 0.0

    def level(self, rate: float, load: float) -> float:
        """N m at which the bristles slide, at this `rate` (rad/s) and `load` (N m)."""
        return self._size

    def torque(self, plant: Rolling) -> float:
        """N m on the roll axis, where the gyroscopic torque is the load; called once per step."""
        return self.force(plant.roll_rate, plant.gyroscopic_torque, plant.step_size)

    def force(self, rate: float, load: float, step: float) -> float:
        """N m on the part that turns at `rate` rad/s; called once per step of `step` s."""
        level = self.level(rate, load)
        if level <= 0.0:
            self._deflection = 0.0
            return 0.0
        slide = 1.0 + step * abs(rate) * self._stiffness / level
        before = self._deflection
        self._deflection = (before + step * rate) / slide
        bend_rate = (self._deflection - before) / step
        return -self._stiffness * (self._deflection + self._damping * bend_rate)


class StribeckFriction(LuGreFriction):
    """Slides at the full torque `size` when slow and at half of it when faster than `stribeck_rate` rad/s."""

    def __init__(
        self,
        size: float,
        deflection: float = BRISTLE_DEFLECTION,
        stribeck_rate: float = STRIBECK_RATE,
        damping: float = BRISTLE_DAMPING,
    ) -> None:
        super().__init__(size, deflection, damping)
        self._stribeck_rate = stribeck_rate

    def level(self, rate: float, load: float) -> float:
        return self._size * (0.5 + 0.5 * math.exp(-((rate / self._stribeck_rate) ** 2)))


class AsymmetricFriction(LuGreFriction):
    """Slides at the full torque `size` if the rate is positive and at a third of it the other way."""

    def level(self, rate: float, load: float) -> float:
        return self._size if rate > 0.0 else self._size / 3.0


class LoadDependentFriction(LuGreFriction):
    """Slides at a share of the torque that the bearings carry; `typical_load` N m sets the bristles' stiffness."""

    def __init__(
        self,
        share: float,
        deflection: float = BRISTLE_DEFLECTION,
        typical_load: float = 300.0,
        damping: float = BRISTLE_DAMPING,
    ) -> None:
        super().__init__(share * typical_load, deflection, damping)
        self._share = share

    def level(self, rate: float, load: float) -> float:
        return self._share * abs(load)


class BoucWenHysteresis:
    """Torque that follows the roll angle elastically, then yields; rate-independent."""

    YIELD = 2.0e-3  # rad
    SHARPNESS = 1.5

    def __init__(self, size: float) -> None:
        self._size = size
        self._state = 0.0

    def torque(self, plant: Rolling) -> float:
        travel = plant.roll_rate * plant.step_size / self.YIELD
        state = self._state
        if travel * state > 0.0:
            travel *= 1.0 - min(1.0, abs(state) ** self.SHARPNESS)
        self._state = state + travel
        return -self._size * self._state
