"""Do accelerometer and gyro tell of the same motion?

Gravity and the acceleration of the lever arm follow from the gyro (estimators.roll_filter.RollState.contradiction), the
acceleration of the axis from the drives. What the accelerometer shows beyond these is vibration as long as all are
right: noise without a mean. A gyro that is frozen, dead, turned or scaled leaves a mean, in the direction of the motion
that it does not show. The mean is taken over AVERAGED, in standard deviations, from the noise that the vehicle file
states or, if it is more, that was measured over REMEMBERED. Single readings count up to CLIPPED deviations, so that a
shock is no contradiction.
"""

from __future__ import annotations

import math

from telemetry.samples import Vector3

AVERAGED = 0.06
"""s, time constant of the mean: short against a fall, long against vibration."""
REMEMBERED = 10.0
"""s over which the vibration is measured."""
CLIPPED = 3.0
"""Standard deviations up to which a reading counts."""


class ImuConsistency:
    """Pass every contradiction to `update`, which returns the largest mean of an axis in standard deviations."""

    __slots__ = ("_forget", "_gain", "_known", "_means", "_per_reading", "_squares")

    def __init__(self, rate: float, acceleration_std: float) -> None:
        """`rate` (Hz) of the IMU, `acceleration_std` (m/s^2) of one reading."""
        self._gain = -math.expm1(-1.0 / (rate * AVERAGED))
        self._forget = 1.0 / (rate * REMEMBERED)
        self._known = acceleration_std**2
        # Of the mean of independent readings; those of the filter are means of two each, whose sum is the same.
        self._per_reading = math.sqrt((2.0 - self._gain) / self._gain)
        self.reset()

    def reset(self) -> None:
        """Forget all readings."""
        self._means = [0.0, 0.0, 0.0]
        self._squares = [self._known] * 3

    def update(self, contradiction: Vector3) -> float:
        """The means with one more reading (m/s^2); not a number if it is none."""
        means, squares, worst = self._means, self._squares, 0.0
        for axis, reading in enumerate(contradiction):
            std = math.sqrt(max(self._known, squares[axis]))
            most = CLIPPED * std
            counted = most if reading > most else -most if reading < -most else reading
            squares[axis] += self._forget * (counted * counted - squares[axis])
            means[axis] += self._gain * (counted - means[axis])
            found = abs(means[axis]) * self._per_reading / std
            if not found <= worst:
                worst = found
            if worst != worst:
                break
        return worst
