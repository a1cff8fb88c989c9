"""How a MONOCAB gets up, balances and gets down: gimbals to the middle, the step from rest, the LQI, the lowering.

The reduced LQI gets it up and down. The full one takes over when the motion of getting up has decayed. Afterwards the
trim mass stays where it balances the vehicle until that lies on a support, and then returns to where it was before: its
place may have been chosen to balance the empty vehicle.
"""

from __future__ import annotations

from math import copysign, radians

from upright.drivers.cia402.states import State
from upright.models.control_design.robustness import CheckedDesign
from upright.vehicles.contract import Command, Lean
from upright.vehicles.experiment.excitation import Excitation
from upright.vehicles.monocab.axes import GimbalMeasurement
from upright.vehicles.monocab.control.controller import RollController
from upright.vehicles.monocab.control.full import FullController, FullState
from upright.vehicles.monocab.control.linear_model import MonocabParameters
from upright.vehicles.monocab.control.rise import Lowering, RiseFromRest, lowering_side, lowering_travel, rise_rate
from upright.vehicles.monocab.control.roll_design import RollDesign
from upright.vehicles.monocab.file import FULL, ROLL_REFERENCE, TRIM_RATE, MonocabFile
from upright.vehicles.sections import REST

CENTRE_RATE = 0.08
"""rad/s: 264 N m at 3300 N m s, a quarter of the torque that would lift the vehicle off the support."""

CENTRED = 0.005
"""rad of precession that counts as the middle."""

TRIM_BACK_RATE = 0.03
"""m/s, at rest. A trim mass of 500 kg at 0.4 m that reaches it within 0.08 s reacts with 75 N m, less than a tenth of
what would lift the vehicle off its support."""

TRIM_BACK = 0.001
"""m from its place before that counts as back: 5 N m of 500 kg."""

DECAYED = 0.01
"""Share to which the motion of getting up has decayed when the full controller takes over."""


def entering(at: str, excitation: float) -> tuple[float, float, float]:
    """The excitation of roll reference (rad), precession rate (rad/s) and trim rate (m/s) if it enters `at`."""
    if at == ROLL_REFERENCE:
        return excitation, 0.0, 0.0
    if at == TRIM_RATE:
        return 0.0, 0.0, excitation
    return 0.0, excitation, 0.0


class GimbalHandling:
    """Setpoints are precession rates, rad/s, and those of the trim mass, m/s.

    `support` and `budget` (of precession) in rad. The excitation enters `at` an injection point; on the support the
    trim mass moves by `trim_per_gimbal` m/rad. `full` takes over after `settling` s upright; None if the reduced
    controller stays.
    """

    def __init__(
        self,
        controller: RollController,
        rise: RiseFromRest,
        parameters: MonocabParameters,
        *,
        support: float,
        budget: float,
        at: str,
        trim_per_gimbal: float,
        full: FullController | None,
        settling: float,
    ) -> None:
        self._controller = controller
        self._rise = rise
        self._parameters = parameters
        self._support = support
        self._budget = budget
        self._at = at
        self._trim_per_gimbal = trim_per_gimbal
        self._full = full
        self._settling = settling
        self._upright, self._fully = 0.0, False
        self._trim_before = 0.0
        self._side = 0.0
        self._lowering: Lowering | None = None

    @classmethod
    def of(
        cls,
        vehicle: MonocabFile,
        reduced: RollDesign,
        full: CheckedDesign | None,
        excitation: Excitation,
        controller: str | None,
    ) -> GimbalHandling:
        """For an experiment with this excitation and one of the vehicle's controllers, `reduced` or `full`. The step
        sets its own rate of rising; the other experiments use one with a margin."""
        parameters = reduced.parameters
        by_step = excitation.at == REST and excitation.peak > 0.0
        rate = excitation.peak if by_step else rise_rate(parameters, vehicle.support)
        return cls(
            RollController.from_design(reduced, vehicle),
            RiseFromRest(rate, acceleration=vehicle.limits.precession_acceleration),
            parameters,
            support=vehicle.support,
            budget=radians(vehicle.limits.precession_budget_deg),
            at=excitation.at,
            trim_per_gimbal=vehicle.limits.trim_rate / vehicle.limits.precession_rate,
            full=FullController.from_design(full, vehicle) if full and controller == FULL else None,
            settling=reduced.settling(DECAYED),
        )

    @property
    def risen(self) -> bool:
        return self._rise.done

    @property
    def failure(self) -> str:
        return self._rise.failure

    @property
    def lowered(self) -> bool:
        return self._lowering is not None and self._lowering.done

    def centre(self, drives: GimbalMeasurement) -> Command | None:
        """Slowly, so that the torque stays well below the one that would lift the vehicle off its support."""
        if not self._fully:
            self._trim_before = drives.trim_position
        off = drives.trim_position - self._trim_before
        if abs(drives.precession) < CENTRED and abs(off) < TRIM_BACK:
            return None
        rate = max(-CENTRE_RATE, min(CENTRE_RATE, -2.0 * drives.precession))
        trim = max(-TRIM_BACK_RATE, min(TRIM_BACK_RATE, -2.0 * off)) if abs(off) >= TRIM_BACK else 0.0
        return Command(State.OPERATION_ENABLED, rate, others=(trim,))

    def move(self, dt: float, drives: GimbalMeasurement, excitation: float) -> Command:
        """The gimbals, and the trim mass in the same proportion of its limit."""
        trim = excitation * self._trim_per_gimbal
        return Command(State.OPERATION_ENABLED, excitation, 0.0, excitation, others=(trim,))

    def rise(self, dt: float, lean: Lean, drives: GimbalMeasurement) -> Command:
        """The paper's step from rest, which is an excitation of its own."""
        if self._side == 0.0:
            self._side = copysign(1.0, lean.angle)
        rate = self._rise.step(dt, lean.angle, lean.rate)
        if self._rise.done:
            self.stand(rate)
        return Command(State.OPERATION_ENABLED, rate, 0.0, rate)

    def stand(self, rate: float) -> None:
        """It is upright, got up with `rate` (rad/s) as the last setpoint."""
        self._controller.reset(rate)

    def balance(self, dt: float, lean: Lean, drives: GimbalMeasurement, excitation: float) -> Command:
        """The LQI, with the excitation on the roll reference or on the precession rate."""
        self._upright += dt
        if self._full is not None and self._upright > self._settling:
            return self._balance_fully(self._full, dt, lean, drives, excitation)
        reference, output, trim = entering(self._at, excitation)
        rate = self._controller.step(
            lean.angle, lean.rate, drives.precession_rate, drives.precession, reference, dt, output
        )
        others = (trim,) if self._at == TRIM_RATE else ()
        return Command(State.OPERATION_ENABLED, rate, self._controller.reference, excitation, others=others)

    def _balance_fully(
        self, full: FullController, dt: float, lean: Lean, drives: GimbalMeasurement, excitation: float
    ) -> Command:
        reference, output, trim = entering(self._at, excitation)
        state = FullState(
            lean.angle - reference,
            lean.rate,
            drives.trim_position,
            drives.trim_rate,
            drives.precession,
            drives.precession_rate,
        )
        if not self._fully:
            full.take_over(state, self._controller.setpoint)
            self._fully = True
        full.step(state, dt, output)
        return Command(
            State.OPERATION_ENABLED, full.setpoint, reference, excitation, others=(full.trim_setpoint + trim,)
        )

    def lower(self, dt: float, lean: Lean, drives: GimbalMeasurement) -> Command:
        """Onto the support it came from, unless that would turn the gimbals too far."""
        if self._lowering is None:
            if self._full is not None and self._fully:
                self._controller.take_over(lean.angle, lean.rate, drives.precession_rate, self._full.setpoint)
            travel = lowering_travel(self._parameters, self._support)
            side = lowering_side(self._side, drives.precession, travel, self._budget)
            self._lowering = Lowering(side * self._support, self._controller)
        rate = self._lowering.step(dt, lean.angle, lean.rate, drives.precession_rate, drives.precession)
        return Command(State.OPERATION_ENABLED, rate, self._lowering.reference)
