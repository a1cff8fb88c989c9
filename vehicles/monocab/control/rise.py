"""Getting up from a support, and down onto one again.

Each is a small state object that is stepped once per control cycle and gives the precession rate setpoint; neither does
I/O nor reads a clock. Signs: see `vehicles.monocab.control.linear_model`; the support on the right is at positive roll.

Their cost in precession follows from the balance of angular momentum between two states at rest:

    angular_momentum * (change of precession) = -gravity_stiffness * (integral of roll over the time off the support)

so both getting up from and going down onto the right support turn the gimbals in the negative direction.
"""

from __future__ import annotations

from enum import Enum
from math import copysign, cos, degrees, pi

from upright.vehicles.monocab.control.controller import RollController
from upright.vehicles.monocab.control.linear_model import MonocabParameters

LIFT_OFF = 0.005
"""rad (0.3 deg) of roll away from rest that count as lifted off."""
LIFT_OFF_TIMEOUT = 1.0
"""s; a sufficient step lifts the vehicle sooner, and after this time the gimbals have little travel left."""
UPRIGHT_TIMEOUT = 1.5
"""s from the start of the step; twice what it should take, and still within the precession budget."""
LEAD = 0.15
"""s before the vehicle passes upright at which the controller takes over: the time that it needs to catch it."""

LOWERING_TIME = 1.5
"""s. Quick, because holding the vehicle near its support costs a steady precession."""
OVERSHOOT = 1.05
"""End of the lowering reference over the support's angle: it reaches a support that sits a little lower."""
CONTACT_SHARE = 0.8
"""Share of the support's angle beyond which standing still means resting on it."""
CONTACT_RATE = 0.02
"""rad/s of roll that count as standing still."""
CONTACT_TIME = 0.06
"""s of standing still that count as contact."""
CONTACT_TIMEOUT = 1.0
"""s after the reference has ended; then the vehicle is released, a fraction of a degree above its support."""

RELEASE = 2.0
"""rad/s^2 at which the setpoint is ramped to zero once a support carries the vehicle."""


def rise_rate(parameters: MonocabParameters, support: float, margin: float = 1.6) -> float:
    """The precession rate (rad/s) of a step that gets the vehicle up: `margin` times the rate that would just hold it.

    `support` (rad) is the roll angle at rest. The margin covers errors of the CAD values, and a static torque.
    """
    return margin * parameters.gravity_stiffness * abs(support) / parameters.angular_momentum


def lowering_travel(parameters: MonocabParameters, support: float) -> float:
    """The precession (rad, positive) that going down onto a support at `support` rad takes."""
    return parameters.gravity_stiffness * abs(support) * LOWERING_TIME / (2.0 * parameters.angular_momentum)


def lowering_side(origin: float, precession: float, travel: float, budget: float) -> float:
    """The side to go down to, +1.0 right or -1.0 left: `origin`, unless that would exceed the precession budget.

    `travel` is that of `lowering_travel`; `precession`, `travel` and `budget` in rad.
    """
    if abs(precession - origin * travel) <= budget:
        return origin
    return copysign(1.0, precession)


class RiseState(Enum):
    """The stage of a rise from rest."""

    LIFTING = "lifting"
    RELEASING = "releasing"
    UPRIGHT = "upright"
    FAILED = "failed"


class RiseFromRest:
    """The paper's step from rest: a constant precession rate lifts the vehicle until it is about upright.

    When `done`, the controller takes over (`RollController.reset(rise.setpoint)`). If the vehicle does not lift off or
    does not come up, the rate is ramped down first, and then `failure` says why.
    """

    __slots__ = ("_acceleration", "_elapsed", "_lifted", "_rate", "_reason", "_rest", "_side", "setpoint", "state")

    def __init__(self, rate: float, *, acceleration: float) -> None:
        """`rate` is the amplitude of the step in rad/s, `acceleration` the limit of the setpoint's in rad/s^2."""
        self._rate = rate
        self._acceleration = acceleration
        self._side = 0.0
        self._rest = 0.0
        self._elapsed = 0.0
        self._lifted = False
        self._reason = ""
        self.setpoint = 0.0
        self.state = RiseState.LIFTING

    @property
    def done(self) -> bool:
        """Whether the vehicle is about upright."""
        return self.state is RiseState.UPRIGHT

    @property
    def failure(self) -> str:
        """Why the vehicle did not get up, in words; empty while it still may."""
        return self._reason if self.state is RiseState.FAILED else ""

    def step(self, dt: float, roll: float, roll_rate: float) -> float:
        """One cycle: the precession rate setpoint, rad/s. The first one sets the side that the vehicle rests on."""
        if self.state is RiseState.LIFTING:
            if self._side == 0.0:
                self._side = copysign(1.0, roll)
                self._rest = abs(roll)
            self._elapsed += dt
            height = self._side * roll
            self._lifted = self._lifted or height < self._rest - LIFT_OFF
            if height + LEAD * self._side * roll_rate <= 0.0:
                self.state = RiseState.UPRIGHT
            elif not self._lifted and self._elapsed > LIFT_OFF_TIMEOUT:
                self._give_up(
                    f"the vehicle did not lift off within {LIFT_OFF_TIMEOUT:g} s at {self._rate:.3g} rad/s of "
                    "precession: a gimbal turns the other way (direction), the IMU is turned (imu.axes), the flywheels "
                    "are slow, the gravity stiffness is larger than assumed, or something holds it down"
                )
            elif self._elapsed > UPRIGHT_TIMEOUT:
                self._give_up(
                    f"the vehicle lifted off but was not upright within {UPRIGHT_TIMEOUT:g} s at {self._rate:.3g} "
                    f"rad/s of precession (roll {degrees(roll):.2f} deg): the rate is too small, or something holds it"
                )
            else:
                self.setpoint = _towards(-self._side * self._rate, self.setpoint, self._acceleration * dt)
        elif self.state is RiseState.RELEASING:
            self.setpoint = _towards(0.0, self.setpoint, RELEASE * dt)
            if self.setpoint == 0.0:
                self.state = RiseState.FAILED
        return self.setpoint

    def _give_up(self, reason: str) -> None:
        self._reason = reason
        self.state = RiseState.RELEASING


class LoweringState(Enum):
    """The stage of a lowering."""

    GUIDED = "guided"
    RELEASING = "releasing"
    AT_REST = "at rest"


class Lowering:
    """From upright onto a support: guided there by the controller, then released.

    GUIDED: the controller follows `reference`, half a cosine from where it was to just beyond the support, without
    the lean that returns the gimbals. RELEASING: the support carries, the setpoint is ramped to zero. AT_REST: `done`.
    """

    __slots__ = ("_controller", "_elapsed", "_end", "_setpoint", "_start", "_still", "_support", "reference", "state")

    def __init__(self, support: float, controller: RollController) -> None:
        """`support` (rad) is the roll angle of the support to go down to, with its sign."""
        self._controller = controller
        self._support = support
        self._start = controller.reference
        self._end = OVERSHOOT * support
        self._elapsed = 0.0
        self._still = 0.0
        self._setpoint = controller.setpoint
        self.reference = controller.reference
        self.state = LoweringState.GUIDED
        controller.lean_on = False

    @property
    def done(self) -> bool:
        """Whether the vehicle rests on the support and the setpoint is zero."""
        return self.state is LoweringState.AT_REST

    def step(self, dt: float, roll: float, roll_rate: float, precession_rate: float, precession: float) -> float:
        """One cycle: the precession rate setpoint, rad/s."""
        if self.state is LoweringState.GUIDED:
            self._elapsed += dt
            still = roll / self._support > CONTACT_SHARE and abs(roll_rate) < CONTACT_RATE
            self._still = self._still + dt if still else 0.0
            if self._still < CONTACT_TIME and self._elapsed < LOWERING_TIME + CONTACT_TIMEOUT:
                share = 0.5 - 0.5 * cos(pi * min(self._elapsed / LOWERING_TIME, 1.0))
                self.reference = self._start + (self._end - self._start) * share
                self._setpoint = self._controller.step(roll, roll_rate, precession_rate, precession, self.reference, dt)
                return self._setpoint
            self.state = LoweringState.RELEASING
        self._setpoint = _towards(0.0, self._setpoint, RELEASE * dt)
        if self._setpoint == 0.0:
            self.state = LoweringState.AT_REST
        return self._setpoint


def _towards(goal: float, value: float, step: float) -> float:
    """`value` moved by at most `step` towards `goal`."""
    difference = goal - value
    return goal if abs(difference) <= step else value + copysign(step, difference)
