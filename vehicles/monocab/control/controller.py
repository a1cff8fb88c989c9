"""The roll controller of the MONOCAB: reduced LQI state feedback, and the lean that brings the gimbals back.

Inner loop, one step per control cycle (gains from `models.control_design.lqi`):

    setpoint = -(k_roll * (roll - reference) + k_rate * roll_rate + k_precession * precession_rate
                 + k_acceleration * precession acceleration + k_jerk * its derivative
                 + k_previous * setpoint before + k_integral * q) + excitation,        q' = roll - reference

The acceleration in the gimbals' speed loop and its derivative are computed from the setpoints (control.speed_loop).

Outer loop: the gyroscopes give torque only while they precess, and the reduced LQI does not see the precession angle,
so a static torque would turn the gimbals to their stops. Leaning by `reference` gives, in the steady state of

    inertia * roll'' = gravity_stiffness * roll + angular_momentum * precession' + static_torque,

precession' = -(gravity_stiffness * reference + static_torque) / angular_momentum. With the lean

    reference = (angular_momentum / gravity_stiffness) * (2 / T * precession + 1 / T^2 * integral of precession)

the precession angle obeys precession'' + (2 / T) * precession' + precession / T^2 = 0: both poles at -1/T, and a
constant static torque has no influence on it. In steady state the vehicle leans against that torque with the gimbals in
the middle. T is `precession_return_time`; it must be slow compared with the inner loop, since a lean is reached by
precessing the wrong way first.

Signs: see `vehicles.monocab.control.linear_model`. Angles in rad, rates in rad/s.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import radians

from upright.models.control_design.lqi import LqiGains, LqiWeights
from upright.models.control_design.robustness import Known
from upright.vehicles.monocab.control.linear_model import MonocabParameters
from upright.vehicles.monocab.control.roll_design import RollDesign, design_roll_controller
from upright.vehicles.monocab.control.speed_loop import speed_loops
from upright.vehicles.monocab.file import MonocabFile

WINDUP_TIME = 0.1
"""s, time constant with which back-calculation reduces the integral while the limits hold back the setpoint."""


@dataclass(frozen=True, slots=True)
class SetpointLimits:
    """Of the precession rate setpoint: `rate` in rad/s, `acceleration` in rad/s^2."""

    rate: float
    acceleration: float


def design(vehicle: MonocabFile, *, spread: float = 0.2, known: Known | None = None) -> RollDesign:
    """The roll controller of a vehicle file, designed from its parameters and checked `spread` (20 %) around them, or
    wherever they may be if they are `known` from estimates.

    Raises ControlDesignError; see `models.control_design.lqi`.
    """
    section = vehicle.controller
    of_states = (section.roll_weight, section.roll_rate_weight, 0.0, 0.0, 0.0)
    weights = LqiWeights(of_states, (section.integral_weight,), (section.effort_weight,))
    parameters = MonocabParameters.from_values(vehicle.parameters.values)
    return design_roll_controller(parameters, weights, vehicle.period, spread=spread, known=known)


class PrecessionReturn:
    """The outer loop: precession angle in, lean of the vehicle out; the lean is limited in amplitude and rate."""

    __slots__ = ("_integral", "_integral_gain", "_lean", "_limit", "_proportional", "_slew")

    def __init__(self, parameters: MonocabParameters, time: float, limit: float) -> None:
        """`time` in s (0: off, as in the paper), `limit` of the lean in rad; it takes a quarter of `time` to reach."""
        ratio = parameters.angular_momentum / parameters.gravity_stiffness
        self._proportional = 2.0 * ratio / time if time else 0.0
        self._integral_gain = ratio / time**2 if time else 0.0
        self._slew = 4.0 * limit / time if time else 0.0
        self._limit = limit
        self.reset()

    def reset(self) -> None:
        """Stand straight, and assume no static torque."""
        self._integral = 0.0
        self._lean = 0.0

    def step(self, precession: float, dt: float) -> float:
        """The lean in rad. The integral is held while the limit is active and it would grow further."""
        integral = self._integral + self._integral_gain * precession * dt
        wanted = self._proportional * precession + integral
        limit = self._limit
        if wanted > limit:
            wanted = limit
            if precession < 0.0:
                self._integral = integral
        elif wanted < -limit:
            wanted = -limit
            if precession > 0.0:
                self._integral = integral
        else:
            self._integral = integral
        change, slew = wanted - self._lean, self._slew * dt
        self._lean += slew if change > slew else -slew if change < -slew else change
        return self._lean


class RollController:
    """Holds the vehicle up: the state in, the precession rate setpoint out.

    `reference` is the roll angle aimed at in the last step, lean included; `setpoint` the output of the last step;
    `limited` whether the limits reduced it. `lean_on` switches the outer loop; off, the vehicle is held at the
    reference that it is given.
    """

    __slots__ = (
        "_acceleration",
        "_acceleration_gain",
        "_gimbals",
        "_integral",
        "_integral_gain",
        "_jerk_gain",
        "_precession_gain",
        "_previous_gain",
        "_rate",
        "_rate_gain",
        "_return",
        "_roll_gain",
        "lean_on",
        "limited",
        "reference",
        "setpoint",
    )

    def __init__(self, gains: LqiGains, limits: SetpointLimits, precession_return: PrecessionReturn) -> None:
        ((self._roll_gain, self._rate_gain, self._precession_gain, self._acceleration_gain, self._jerk_gain),) = (
            gains.states
        )
        ((self._previous_gain,),) = gains.previous
        ((self._integral_gain,),) = gains.integral
        self._rate = limits.rate
        self._acceleration = limits.acceleration
        self._return = precession_return
        (self._gimbals,) = speed_loops(gains)
        self.reset(0.0)

    @classmethod
    def from_design(cls, design: RollDesign, vehicle: MonocabFile) -> RollController:
        """The controller of a vehicle file, with the gains of its design."""
        limits, section = vehicle.limits, vehicle.controller
        return cls(
            design.gains,
            SetpointLimits(limits.precession_rate, limits.precession_acceleration),
            PrecessionReturn(
                design.parameters, section.precession_return_time, radians(section.precession_return_limit_deg)
            ),
        )

    def reset(self, setpoint: float) -> None:
        """Take over from whoever sent `setpoint` (rad/s) last.

        The setpoint continues from there, within the acceleration limit. The integral starts at zero: matched to the
        setpoint it would keep the torque that lifts the vehicle, and throw it over.
        """
        self._integral = 0.0
        self._return.reset()
        self._gimbals.begin(setpoint)
        self.setpoint = setpoint
        self.reference = 0.0
        self.limited = False
        self.lean_on = True

    def take_over(self, roll: float, roll_rate: float, precession_rate: float, setpoint: float) -> None:
        """Take over from another controller of a vehicle that is upright: the setpoint it sent last (rad/s) would be
        sent again."""
        self.reset(setpoint)
        self._gimbals.begin(precession_rate)
        held = self._roll_gain * roll + self._rate_gain * roll_rate + self._precession_gain * precession_rate
        self._integral = -(setpoint + held + self._previous_gain * setpoint) / self._integral_gain

    def step(
        self,
        roll: float,
        roll_rate: float,
        precession_rate: float,
        precession: float,
        reference: float,
        dt: float,
        excitation: float = 0.0,
    ) -> float:
        """One cycle: the precession rate setpoint, rad/s.

        `precession_rate` and `precession` are the gimbals' as measured; `reference` (rad) does not include the lean;
        `excitation` (rad/s) is added to the controller's output, before the limits; `dt` s since the last cycle.
        """
        if self.lean_on:
            reference += self._return.step(precession, dt)
        self.reference = reference
        error = roll - reference
        before, gimbals = self.setpoint, self._gimbals
        wanted = excitation - (
            self._roll_gain * error
            + self._rate_gain * roll_rate
            + self._precession_gain * precession_rate
            + self._acceleration_gain * gimbals.acceleration
            + self._jerk_gain * gimbals.jerk
            + self._previous_gain * before
            + self._integral_gain * self._integral
        )
        gimbals.step(before)
        change = self._acceleration * dt
        setpoint = wanted
        if setpoint > before + change:
            setpoint = before + change
        elif setpoint < before - change:
            setpoint = before - change
        if setpoint > self._rate:
            setpoint = self._rate
        elif setpoint < -self._rate:
            setpoint = -self._rate
        share = dt / WINDUP_TIME
        self._integral += dt * error + (wanted - setpoint) / self._integral_gain * (share if share < 1.0 else 1.0)
        self.limited = setpoint != wanted
        self.setpoint = setpoint
        return setpoint
