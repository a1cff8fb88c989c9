"""A flywheel with the inverter that drives it: spun up with a limited torque, kept at its speed, left to run down.

    inertia speed' = motor - bearings - windage speed^2

Numbers are those of a steel disc of some 2.6 kg m^2 in air; they are assumed, since no data sheet is known.
"""

from __future__ import annotations

from dataclasses import dataclass

BEARINGS = 1.5
"""N m, dry friction of the bearings."""
WINDAGE = 2.5e-5
"""N m s^2: 10 N m at 6,000 rpm, in air."""
BLEND = 0.5
"""rad/s below which the friction of the bearings fades, so that it does not turn the wheel backwards."""
MOST = 60.0
"""N m of the motor."""
STIFFNESS = 20.0
"""N m s, of the inverter's speed control."""


@dataclass(slots=True)
class Flywheel:
    """`speed` rad/s, with the `inertia` kg m^2 and the speed `nominal` that its inverter keeps while it is `on`."""

    inertia: float
    nominal: float
    speed: float
    on: bool = True

    @property
    def steady(self) -> bool:
        """Whether it turns at its speed exactly, and stays there."""
        return self.on and self.speed == self.nominal

    @property
    def drag(self) -> float:
        """N m against its motion."""
        speed = self.speed
        bearings = BEARINGS * max(-1.0, min(1.0, speed / BLEND))
        return bearings + WINDAGE * speed * abs(speed)

    def advance(self, step: float) -> None:
        """Move on by `step` s."""
        motor = 0.0
        if self.on:
            motor = max(-MOST, min(MOST, self.drag + STIFFNESS * (self.nominal - self.speed)))
        self.speed += step * (motor - self.drag) / self.inertia
