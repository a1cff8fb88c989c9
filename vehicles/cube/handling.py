"""How the cube gets up, balances and gets down.

The controller brings it up from its support by itself: the torque of gravity there is less than half of the drive's.
To get down it tips at LOWERING_RATE; the wheel takes up the momentum, and is then braked on the support with less
torque than would lift the cube off it.
"""

from __future__ import annotations

from math import copysign, sin

from upright.drivers.cia402.states import State
from upright.vehicles.contract import HOLD, Command, Lean
from upright.vehicles.cube.axes import WheelMeasurement
from upright.vehicles.cube.controller import WheelController
from upright.vehicles.rising import Rising, Upright

UPRIGHT = Upright(angle=0.035, rate=0.3, time=0.2, timeout=0.8)
"""2 deg of tilt, either way. Getting up takes a fifth of a second; at full torque the wheel reaches its budget in
0.9 s."""
LOWERING_RATE = 0.3
"""rad/s of tilt: half a second to the support."""
LOWERING_DAMPING = 20.0
"""1/s, gain with which the rate of lowering is held."""
LYING_SHARE = 0.8
"""Share of the supports' angle beyond which the cube is left to lie down."""
LYING_RATE = 0.02
"""rad/s of tilt that count as standing still."""
LYING_TIME = 0.2
"""s of standing still that count as lying: the cube bounces off a support a little."""
BRAKING_SHARE = 0.3
"""Share of the torque of gravity on the support: braking the wheel must not lift the cube off it."""
WHEEL_AT_REST = 1.0
"""rad/s."""


class CubeHandling:
    """Setpoints are torques on the wheel, N m.

    `support` (rad) is the tilt on a support, `inertia` (kg m^2) and `gravity_stiffness` (N m/rad) those of the body.
    """

    def __init__(
        self, controller: WheelController, *, support: float, inertia: float, gravity_stiffness: float
    ) -> None:
        self.lowered = False
        self._controller = controller
        self._support = support
        self._inertia = inertia
        self._gravity_stiffness = gravity_stiffness
        self._rising = Rising(UPRIGHT, "cube", "its drive is weak, its wheel drags, or something holds it")
        self._lying = 0.0

    def centre(self, drives: WheelMeasurement) -> Command | None:
        """Bring the wheel to rest; it has no middle."""
        if abs(drives.rate) < WHEEL_AT_REST:
            return None
        most = BRAKING_SHARE * self._gravity_stiffness * sin(self._support)
        return Command(State.OPERATION_ENABLED, -copysign(most, drives.rate))

    def move(self, dt: float, drives: WheelMeasurement, excitation: float) -> Command:
        """A torque at the wheel."""
        return Command(State.OPERATION_ENABLED, excitation, 0.0, excitation)

    @property
    def risen(self) -> bool:
        return self._rising.risen

    @property
    def failure(self) -> str:
        return self._rising.failure

    def rise(self, dt: float, lean: Lean, drives: WheelMeasurement) -> Command:
        """Balance, from the support; it is up when it has stayed upright for a moment."""
        self._rising.step(dt, lean)
        return HOLD if self.failure else self.balance(dt, lean, drives, 0.0)

    def balance(self, dt: float, lean: Lean, drives: WheelMeasurement, excitation: float) -> Command:
        """The LQI, with the excitation on the torque."""
        torque = self._controller.step(lean.angle, lean.rate, drives.rate, dt, excitation)
        return Command(State.OPERATION_ENABLED, torque, excitation=excitation)

    def lower(self, dt: float, lean: Lean, drives: WheelMeasurement) -> Command:
        """Let it down to the side that it got up from, and lie."""
        lying = abs(lean.angle) > LYING_SHARE * self._support
        self._lying = self._lying + dt if lying and abs(lean.rate) < LYING_RATE else 0.0
        self.lowered = self._lying >= LYING_TIME
        if lying:
            return HOLD
        too_fast = lean.rate - self._rising.side * LOWERING_RATE
        torque = self._gravity_stiffness * sin(lean.angle) + self._inertia * LOWERING_DAMPING * too_fast
        return Command(State.OPERATION_ENABLED, torque)
