"""How the balancing robot gets up, balances and gets down.

The controller brings it up from its bumper by itself: it is at the supply's limit for most of the way, while the wheels
drive under the body. Only gravity can lower it: its wheels are driven out from under it, so that it tips towards the
bumper from which it got up, and then the motors get 0 V, which shorts and so brakes them.
"""

from __future__ import annotations

from upright.drivers.cia402.states import State
from upright.vehicles.contract import HOLD, Command, Lean
from upright.vehicles.rising import Rising, Upright
from upright.vehicles.twsbr.axes import WheelMeasurement, Wheels
from upright.vehicles.twsbr.controller import TiltController

UPRIGHT = Upright(angle=0.035, rate=0.5, time=0.2, timeout=4.0)
"""2 deg of tilt, either way; getting up takes half a second, and coming to rest longer if the gears have backlash."""
TIP_VOLTAGE = 3.0
"""V that drive the wheels out from under the body."""
TIPPED = 0.07
"""rad (4 deg) of tilt from which it falls by itself."""
LYING_SHARE = 0.8
"""Share of the bumpers' angle beyond which standing still means lying."""
LYING_RATE = 0.02
"""rad/s of tilt that count as standing still."""
LYING_TIME = 0.2
"""s of standing still that count as lying: the robot bounces off a bumper a little."""


class WheelHandling:
    """Setpoints are voltages, V, the same for both motors.

    `support` (rad) is the tilt on a bumper, `radius` (m) that of a wheel.
    """

    def __init__(
        self, controller: TiltController, wheels: Wheels, *, support: float, radius: float, on_reference: bool
    ) -> None:
        self.lowered = False
        self._controller = controller
        self._wheels = wheels
        self._support = support
        self._radius = radius
        self._on_reference = on_reference
        self._rising = Rising(UPRIGHT, "robot", "the wheels slip, the supply is weak, or something holds it")
        self._lying = 0.0

    def centre(self, drives: WheelMeasurement) -> Command | None:
        """A wheel has no middle: wherever it stands, the travel counts from there."""
        self._wheels.start_here()
        return None

    def move(self, dt: float, drives: WheelMeasurement, excitation: float) -> Command:
        """A voltage at both motors."""
        return Command(State.OPERATION_ENABLED, excitation, 0.0, excitation)

    @property
    def risen(self) -> bool:
        return self._rising.risen

    @property
    def failure(self) -> str:
        return self._rising.failure

    def rise(self, dt: float, lean: Lean, drives: WheelMeasurement) -> Command:
        """Balance, from the bumper; it is up when it has stayed upright for a moment."""
        self._rising.step(dt, lean)
        return HOLD if self.failure else self.balance(dt, lean, drives, 0.0)

    def balance(self, dt: float, lean: Lean, drives: WheelMeasurement, excitation: float) -> Command:
        """The PID, with the excitation on the tilt reference or on the voltage."""
        voltage = self._controller.step(
            lean.angle,
            lean.rate,
            drives.travel + self._radius * lean.angle,
            self._radius * (drives.mean_rate + lean.rate),
            excitation if self._on_reference else 0.0,
            dt,
            0.0 if self._on_reference else excitation,
        )
        return Command(State.OPERATION_ENABLED, voltage, self._controller.reference, excitation)

    def lower(self, dt: float, lean: Lean, drives: WheelMeasurement) -> Command:
        """Tip it over, and let it fall with the motors shorted."""
        still = abs(lean.angle) > LYING_SHARE * self._support and abs(lean.rate) < LYING_RATE
        self._lying = self._lying + dt if still else 0.0
        self.lowered = self._lying >= LYING_TIME
        if abs(lean.angle) < TIPPED:
            return Command(State.OPERATION_ENABLED, -self._rising.side * TIP_VOLTAGE)
        return HOLD
