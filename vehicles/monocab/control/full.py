"""The full stabilisation of the MONOCAB: an LQI over roll, trim mass and precession, with both actuators.

    u = -(K x + K_before u_before + K_integral q) + excitation,       u = [trim rate, precession rate] setpoints,
    x = [roll - reference, roll rate, trim position and its first three derivatives, precession and its first three],
    q' = [roll - reference, precession]

The gyroscopes answer a disturbance at once, and the trim mass takes over what lasts: with the integrals of both outputs
the vehicle stands upright with its gimbals in the middle under any static torque that the trim mass can balance. To
bring the gimbals back, the trim mass moves beyond that place first. Source: Griese et al., equation (1), section II and
figure 4; the design is models.control_design.lqi.

No drive reports the acceleration in its speed loop, so the controller computes it (control.speed_loop). Designed with
one lag in place of each speed loop, it oscillated at 8 Hz on the virtual vehicle: at that frequency the loop by the
symmetric optimum is 135 deg late, a lag of the same time constant 63 deg.

The reduced controller has no use for the trim mass, so each hands over to the other with the setpoints that the drives
have: their integrals are set so that the first setpoints are these.

Signs: see `vehicles.monocab.control.linear_model`. Angles in rad, rates in rad/s, the trim mass in m and m/s.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import sqrt
from operator import mul

import numpy as np

from upright.models.control_design.lqi import ControlDesignError, LqiGains, LqiWeights
from upright.models.control_design.robustness import CheckedDesign, Known, Spread, checked_design
from upright.vehicles.monocab.control.controller import WINDUP_TIME, SetpointLimits
from upright.vehicles.monocab.control.linear_model import MonocabParameters, full_model
from upright.vehicles.monocab.control.roll_design import UNCERTAIN
from upright.vehicles.monocab.control.speed_loop import speed_loops
from upright.vehicles.monocab.file import MonocabFile

TRAVEL = 0.9
"""Share of `limits.trim_position` that the controller uses: at the limit itself the run is stopped. Chosen, not
measured: it leaves room for the lag of the drive."""


@dataclass(frozen=True, slots=True)
class TrimLimits(SetpointLimits):
    """Of the trim rate setpoint: `rate` in m/s, `acceleration` in m/s^2; `travel` m to either side."""

    travel: float


def design_full(vehicle: MonocabFile, *, spread: float = 0.2, known: Known | None = None) -> CheckedDesign:
    """The full controller of a vehicle file, designed from its parameters and checked `spread` (20 %) around them, or
    wherever they may be if they are `known` from estimates.

    Raises ControlDesignError.
    """
    section = vehicle.full_controller
    parameters = MonocabParameters.from_values(vehicle.parameters.values)
    weights = LqiWeights(
        (
            section.roll_weight,
            section.roll_rate_weight,
            *(0.0, section.trim_rate_weight, 0.0, 0.0),
            *(section.precession_weight, 0.0, 0.0, 0.0),
        ),
        (section.roll_integral_weight, section.precession_integral_weight),
        (section.trim_effort_weight, section.effort_weight),
    )
    uncertain = UNCERTAIN if parameters.trim_speed_loop_lag is None else (*UNCERTAIN, "trim_speed_loop_lag")
    return checked_design(
        lambda factors: full_model(parameters.scaled(factors)),
        known.about(uncertain) if known else Spread(uncertain, spread),
        weights,
        vehicle.period,
    )


def full_if_used(vehicle: MonocabFile) -> CheckedDesign | ControlDesignError | None:
    """The full controller if an experiment of the vehicle file uses it, else None; or why there is none, so that the
    other experiments run nevertheless."""
    try:
        return design_full(vehicle) if vehicle.full_experiments else None
    except ControlDesignError as error:
        return error


@dataclass(frozen=True, slots=True)
class FullState:
    """What is measured, in the order of the model's states."""

    roll: float
    roll_rate: float
    trim_position: float
    trim_rate: float
    precession: float
    precession_rate: float


class FullController:
    """Holds the vehicle up with both actuators: the measured state in, both setpoints out.

    `trim_setpoint` and `setpoint` (precession) are the outputs of the last step.
    """

    __slots__ = (
        "_gains",
        "_limits",
        "_loops",
        "_of_precession",
        "_of_roll",
        "_per_setpoint",
        "_trim",
        "setpoint",
        "trim_setpoint",
    )

    def __init__(self, gains: LqiGains, limits: SetpointLimits, trim: TrimLimits) -> None:
        """`limits` of the precession rate, `trim` of the trim mass."""
        self._gains = tuple(map(tuple, gains.matrix.tolist()))
        (a, b), (c, d) = np.linalg.inv(np.array(gains.integral)).tolist()
        self._per_setpoint = ((a, b), (c, d))
        self._loops = speed_loops(gains)
        self._limits, self._trim = limits, trim
        self._of_roll = self._of_precession = 0.0
        self.trim_setpoint = self.setpoint = 0.0

    @classmethod
    def from_design(cls, design: CheckedDesign, vehicle: MonocabFile) -> FullController:
        """The controller of a vehicle file, with the gains of its design."""
        limits = vehicle.limits
        return cls(
            design.gains,
            SetpointLimits(limits.precession_rate, limits.precession_acceleration),
            TrimLimits(limits.trim_rate, limits.trim_acceleration, TRAVEL * limits.trim_position),
        )

    def take_over(self, state: FullState, setpoint: float) -> None:
        """Take over from a controller that sent `setpoint` (rad/s of precession) last, and held the trim mass still:
        the next setpoints would be these again."""
        trim, gimbals = self._loops
        trim.begin(state.trim_rate)
        gimbals.begin(state.precession_rate)
        self.trim_setpoint, self.setpoint = 0.0, setpoint
        self._of_roll = self._of_precession = 0.0
        trim_wanted, wanted = self._wanted(state)
        self._of_roll, self._of_precession = self._in_integrals(trim_wanted, wanted - setpoint)

    def step(self, state: FullState, dt: float, excitation: float = 0.0) -> None:
        """One cycle, after which `trim_setpoint` and `setpoint` are the new ones. `state.roll` is the difference from
        its reference; `excitation` (rad/s) is added to the precession rate, before the limits; `dt` s since the last
        cycle."""
        trim_wanted, wanted = self._wanted(state)
        wanted += excitation
        trim_loop, gimbals = self._loops
        trim_loop.step(self.trim_setpoint)
        gimbals.step(self.setpoint)
        trim = self._trim
        # Towards the end of its travel the trim mass may be as fast as it can still brake.
        fastest = sqrt(2.0 * trim.acceleration * max(0.0, trim.travel - state.trim_position))
        slowest = -sqrt(2.0 * trim.acceleration * max(0.0, trim.travel + state.trim_position))
        trim_setpoint = min(fastest, max(slowest, _within(trim_wanted, self.trim_setpoint, trim, dt)))
        setpoint = _within(wanted, self.setpoint, self._limits, dt)
        of_roll, of_precession = self._in_integrals(trim_wanted - trim_setpoint, wanted - setpoint)
        share = min(1.0, dt / WINDUP_TIME)
        self._of_roll += dt * state.roll + share * of_roll
        self._of_precession += dt * state.precession + share * of_precession
        self.trim_setpoint, self.setpoint = trim_setpoint, setpoint

    def _wanted(self, state: FullState) -> tuple[float, float]:
        """Both setpoints before excitation and limits."""
        trim, gimbals = self._loops
        everything = (
            state.roll,
            state.roll_rate,
            state.trim_position,
            state.trim_rate,
            trim.acceleration,
            trim.jerk,
            state.precession,
            state.precession_rate,
            gimbals.acceleration,
            gimbals.jerk,
            self.trim_setpoint,
            self.setpoint,
            self._of_roll,
            self._of_precession,
        )
        first, second = self._gains
        return -sum(map(mul, first, everything)), -sum(map(mul, second, everything))

    def _in_integrals(self, trim: float, precession: float) -> tuple[float, float]:
        """The rise of both integrals that reduces both setpoints by these amounts."""
        (a, b), (c, d) = self._per_setpoint
        return a * trim + b * precession, c * trim + d * precession


def _within(wanted: float, before: float, limits: SetpointLimits, dt: float) -> float:
    """`wanted` within the limits, `before` being the setpoint of the last cycle."""
    change = limits.acceleration * dt
    setpoint = min(before + change, max(before - change, wanted))
    return min(limits.rate, max(-limits.rate, setpoint))
