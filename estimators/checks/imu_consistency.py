"""Do accelerometer and gyro tell of the same motion?

Gravity and the acceleration of the lever arm follow from the gyro (estimators.roll_filter.RollState.contradiction), the
acceleration of the axis from the drives. What the accelerometer shows beyond these is vibration as long as all are
right: noise without a mean. A gyro that is frozen, dead, turned or scaled leaves a mean, in the direction of the motion
that it does not show: a large one in a fall, and a small one for longer while the vehicle rises. So means are taken
over each of AVERAGED, in standard deviations, from the noise that the vehicle file states or, if it is more, that was
measured over REMEMBERED. Single readings count up to CLIPPED deviations, so that a shock is no contradiction. What an
error of the accelerometer's scale leaves on the support is known before a run.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from upright.telemetry.samples import Vector3

AVERAGED = (0.06, 0.24)
"""s, time constants of the means: short against a fall and long against vibration, and four times as long."""
REMEMBERED = 10.0
"""s over which the vibration is measured, and at rest its mean."""
CLIPPED = 3.0
"""Standard deviations up to which a reading counts."""


class ImuConsistency:
    """Pass every contradiction to `update`, which returns the largest mean of an axis in standard deviations."""

    __slots__ = ("_axes",)

    def __init__(self, rate: float, acceleration_std: float, averaged: Sequence[float] = AVERAGED) -> None:
        """`rate` (Hz) of the IMU, `acceleration_std` (m/s^2) of one reading, `averaged` s."""
        self._axes = tuple(_Axis(rate, acceleration_std, averaged) for _ in range(3))

    def reset(self) -> None:
        """Forget all readings."""
        for axis in self._axes:
            axis.reset()

    def update(self, contradiction: Vector3, *, at_rest: bool = False) -> float:
        """The means with one more reading (m/s^2); not a number if it is none. At rest the vehicle does not move, so
        that a mean says nothing of the gyro."""
        worst = 0.0
        for axis, reading in zip(self._axes, contradiction, strict=True):
            found = axis.update(reading, at_rest)
            if not found <= worst:
                worst = found
            if worst != worst:
                break
        return worst


class _Axis:
    """Readings about their mean at rest, and the means of these over each window."""

    __slots__ = ("_forget", "_known", "_offset", "_resting", "_square", "_windows")

    def __init__(self, rate: float, acceleration_std: float, averaged: Sequence[float]) -> None:
        self._forget = 1.0 / (rate * REMEMBERED)
        self._known = acceleration_std**2
        self._windows = tuple(_Window(rate, each) for each in averaged)
        self.reset()

    def reset(self) -> None:
        self._offset = 0.0
        self._resting = 0
        self._square = self._known
        for window in self._windows:
            window.reset()

    def update(self, reading: float, at_rest: bool) -> float:
        reading -= self._offset
        if at_rest:
            self._resting += 1
            self._offset += max(self._forget, 1.0 / self._resting) * reading
        square = max(self._known, self._square)
        most = CLIPPED * math.sqrt(square)
        counted = most if reading > most else -most if reading < -most else reading
        self._square += self._forget * (counted * counted - self._square)
        worst = 0.0
        for window in self._windows:
            found = window.update(counted, square)
            if not found <= worst:
                worst = found
        return worst


class _Window:
    """A mean over some time, and its variance: `share` of that of a reading if these are independent (those of the
    filter are means of two each, whose sum is the same)."""

    __slots__ = ("_gain", "_mean", "_share")

    def __init__(self, rate: float, averaged: float) -> None:
        self._gain = -math.expm1(-1.0 / (rate * averaged))
        self._share = self._gain / (2.0 - self._gain)
        self.reset()

    def reset(self) -> None:
        self._mean = 0.0

    def update(self, reading: float, square: float) -> float:
        self._mean += self._gain * (reading - self._mean)
        return abs(self._mean) / math.sqrt(self._share * square)
