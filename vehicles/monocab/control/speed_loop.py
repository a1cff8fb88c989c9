"""The speed loop of an axis, as a controller computes it from its own setpoints.

No drive reports the acceleration in its speed loop, which a bandwidth near that of the loop needs: one lag in its place
is 63 deg late where the loop by the symmetric optimum is 135 deg late.
"""

from __future__ import annotations

from collections.abc import Sequence

from upright.models.control_design.lqi import LqiGains


class SpeedLoop:
    """The speed loop of one axis, as the controller computes it from its own setpoints."""

    __slots__ = ("_rows", "acceleration", "jerk", "rate")

    def __init__(self, transition: Sequence[Sequence[float]], inputs: Sequence[float]) -> None:
        """Over one period: `transition` (3, 3) of [rate, acceleration, jerk], and `inputs` (3,) of the setpoint."""
        self._rows = tuple((*row, own) for row, own in zip(transition, inputs, strict=True))
        self.begin(0.0)

    def begin(self, rate: float) -> None:
        """The axis moves steadily at `rate`."""
        self.rate = rate
        self.acceleration = self.jerk = 0.0

    def step(self, setpoint: float) -> None:
        """One period later; `setpoint` is the one that acts in it."""
        rate, acceleration, jerk = self.rate, self.acceleration, self.jerk
        self.rate, self.acceleration, self.jerk = (
            of_rate * rate + of_acceleration * acceleration + of_jerk * jerk + own * setpoint
            for of_rate, of_acceleration, of_jerk, own in self._rows
        )


def speed_loops(gains: LqiGains) -> list[SpeedLoop]:
    """Those of the inputs in turn, at rest, as a controller with these gains computes them."""
    computed = gains.computed
    assert computed is not None
    parts = [slice(first, first + 3) for first in range(0, len(computed.places), 3)]
    return [
        SpeedLoop(computed.transition[part, part].tolist(), computed.inputs[part, number].tolist())
        for number, part in enumerate(parts)
    ]
