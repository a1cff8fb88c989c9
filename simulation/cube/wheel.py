"""The cube's reaction wheel: a motor with its current loop, and an encoder; what its drive moves and measures."""

from __future__ import annotations

import math
import random

from upright.simulation.cube.truth import CubeTruth
from upright.simulation.physics.input_effects import InputEffect


class Wheel:
    """Call `drive` before a step, and `follow` after it. Angles and rates of the wheel are relative to the body."""

    def __init__(self, truth: CubeTruth, step: float, effects: tuple[InputEffect, ...], seed: int) -> None:
        self.powered = False
        self.target = 0.0
        """N m."""
        self.limited = False
        self.demand = 0.0
        self.torque = 0.0
        self._limit = truth.torque_limit
        self.effects = effects
        """What lies between demand and current loop, in the order in which it acts."""
        self._follows = -math.expm1(-step / truth.torque_lag)
        self._pitch = 2.0 * math.pi / truth.encoder_increments_per_turn
        self._smooths = -math.expm1(-step / truth.rate_filter)
        self._step = step
        self._noise = truth.torque_noise
        self._seed = seed
        self._count = 0
        self._rate = 0.0
        self.restart()

    def restart(self) -> None:
        """Restart the noise of the current loop."""
        self._random = random.Random(self._seed)

    @property
    def measured_position(self) -> float:
        """rad, in whole increments."""
        return self._count * self._pitch

    @property
    def measured_rate(self) -> float:
        """rad/s."""
        return self._rate

    def drive(self) -> float:
        """The motor's torque over the next step, N m."""
        target = self.target if self.powered else 0.0
        self.limited = abs(target) > self._limit
        self.demand = min(self._limit, max(-self._limit, target))
        acts = self.demand
        for effect in self.effects:
            acts = effect(acts)
        acts += self._noise * self._random.gauss(0.0, 1.0)
        self.torque = self.torque + self._follows * (acts - self.torque) if self.powered else 0.0
        return self.torque

    def follow(self, angle: float) -> None:
        """Take the wheel's angle at the end of a step, rad."""
        count = math.floor(angle / self._pitch)
        moved = (count - self._count) * self._pitch
        self._count = count
        self._rate += self._smooths * (moved / self._step - self._rate)
