"""One experiment, from rest on a support back to rest on a support: the phases, pure.

    rest -> enable -> centre -> rise -> settle -> excite -> fade -> lower -> centre back -> disable

Every experiment is the whole way, so that each has one verb, one recording, and ends where a person may touch the
vehicle. `ExperimentRun.step` is called once a control cycle and answers with what the drives shall do now; it knows
no bus and no clock, only the time that the samples carry.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from math import copysign, degrees, radians

from drivers.cia402.states import State
from drivers.vehicle_io import Measurement
from estimators.roll_filter import RollState
from models.control_design import RollDesign
from models.monocab import MonocabParameters
from service.controller import RollController
from service.excitation import Excitation, InjectionPoint, make_excitation
from service.rise import Lowering, RiseFromRest, lowering_side, lowering_travel, rise_rate
from service.vehicle_file import VehicleFile

AT_REST_ROLL = 0.0175
"""rad (1 deg): how near to a support's angle counts as resting on it."""

AT_REST_RATE = 0.01
"""rad/s of roll."""

CENTRE_RATE = 0.08
"""rad/s: 264 N m at 3300 N m s, a quarter of what would lift the vehicle off the support."""

CENTRED = 0.005
"""rad of precession that counts as the middle."""


class Phase(IntEnum):
    """Where an experiment is; recorded in channel `phase`."""

    NONE = 0
    REST = 1
    ENABLE = 2
    CENTRE = 3
    RISE = 4
    SETTLE = 5
    EXCITE = 6
    FADE = 7
    LOWER = 8
    CENTRE_BACK = 9
    DISABLE = 10

    @property
    def text(self) -> str:
        """What a person reads."""
        return _TEXTS[self]


_TEXTS = {
    Phase.NONE: "nothing runs",
    Phase.REST: "at rest: the roll filter settles",
    Phase.ENABLE: "enabling the drives",
    Phase.CENTRE: "turning the gimbals to the middle",
    Phase.RISE: "rising from the support",
    Phase.SETTLE: "upright: settling",
    Phase.EXCITE: "exciting",
    Phase.FADE: "excitation over: settling",
    Phase.LOWER: "lowering onto the support",
    Phase.CENTRE_BACK: "on the support: turning the gimbals back",
    Phase.DISABLE: "disabling the drives",
}

DURATIONS = {Phase.REST: 4.0, Phase.SETTLE: 3.0, Phase.FADE: 1.5}
"""s of the phases that just take their time."""

TIMEOUTS = {Phase.ENABLE: 5.0, Phase.CENTRE: 30.0, Phase.LOWER: 12.0, Phase.CENTRE_BACK: 30.0, Phase.DISABLE: 3.0}
"""s after which a phase that should have ended counts as failed. ENABLE bears a drive's pause before re-enabling."""

POWERED = frozenset(set(Phase) - {Phase.NONE, Phase.REST, Phase.ENABLE, Phase.DISABLE})
"""Phases in which every drive must be in Operation enabled."""

BALANCING = frozenset({Phase.RISE, Phase.SETTLE, Phase.EXCITE, Phase.FADE, Phase.LOWER})
"""Phases off the support."""


@dataclass(frozen=True, slots=True)
class Command:
    """What the drives shall do in this cycle, and what led to it."""

    target: State
    precession_rate: float
    roll_reference: float = 0.0
    excitation: float = 0.0


_NEXT = {Phase.SETTLE: Phase.EXCITE, Phase.EXCITE: Phase.FADE, Phase.FADE: Phase.LOWER}

IDLE = Command(State.SWITCH_ON_DISABLED, 0.0)
QUICK_STOP = Command(State.QUICK_STOP_ACTIVE, 0.0)
HOLD = Command(State.OPERATION_ENABLED, 0.0)


@dataclass(frozen=True, slots=True)
class Plan:
    """What one experiment is made of. `support` and `precession_budget` in rad; see `plan`."""

    excitation: Excitation
    controller: RollController
    rise: RiseFromRest
    parameters: MonocabParameters
    support: float
    precession_budget: float


def plan(vehicle: VehicleFile, experiment: str, design: RollDesign) -> Plan:
    """The plan of a vehicle file's experiment. The step sets its own rate of rising; the others take a sure one.

    Raises ExcitationError where the experiment's signal cannot be played.
    """
    section = vehicle.experiments[experiment]
    excitation = make_excitation(section, float(vehicle.control.rate))
    by_step = excitation.at is InjectionPoint.REST and excitation.peak > 0.0
    rate = excitation.peak if by_step else rise_rate(design.parameters, vehicle.support)
    return Plan(
        excitation=excitation,
        controller=RollController.from_design(design, vehicle),
        rise=RiseFromRest(rate, acceleration=vehicle.limits.precession_acceleration),
        parameters=design.parameters,
        support=vehicle.support,
        precession_budget=radians(vehicle.limits.precession_budget_deg),
    )


class ExperimentRun:
    """The course of one experiment. `done` when it is over; `failure` says why where it did not do what it should."""

    def __init__(self, name: str, plan: Plan) -> None:
        self.name = name
        self.phase = Phase.REST
        self.failure = ""
        self.end_reason = ""
        self.done = False
        self._plan = plan
        self._controller = plan.controller
        self._rise = plan.rise
        self._lowering: Lowering | None = None
        self._phase_time = 0.0
        self._side = 1.0

    @property
    def fraction(self) -> float:
        """Share of the expected time that is over, 0 to 1; phases of unknown length count as they come."""
        timed = (*DURATIONS, Phase.EXCITE)
        before = sum(self._duration(phase) for phase in timed if phase < self.phase)
        return min(1.0, (before + (self._phase_time if self.phase in timed else 0.0)) / self._expected)

    @property
    def remaining(self) -> float:
        """s that the experiment still needs, roughly."""
        return (1.0 - self.fraction) * self._expected

    @property
    def _expected(self) -> float:
        return self._plan.excitation.duration + sum(DURATIONS.values())

    def _duration(self, phase: Phase) -> float:
        return self._plan.excitation.duration if phase is Phase.EXCITE else DURATIONS[phase]

    def end(self, reason: str) -> None:
        """End early and in order: if it is up, the vehicle is lowered first."""
        if self.end_reason or self.done:
            return
        self.end_reason = reason
        if self.phase in (Phase.REST, Phase.ENABLE, Phase.CENTRE):
            self._enter(Phase.DISABLE)
        elif self.phase in (Phase.SETTLE, Phase.EXCITE, Phase.FADE):
            self._enter(Phase.LOWER)

    def step(self, dt: float, roll: RollState, drives: Measurement, state: State | None) -> Command:
        """The command of this cycle. `dt` s since the last; `state` is the one all drives are in, if they agree."""
        self._phase_time += dt
        timeout = TIMEOUTS.get(self.phase)
        if timeout is not None and self._phase_time > timeout:
            self._time_out(timeout)
        match self.phase:
            case Phase.REST:
                return self._rest(roll)
            case Phase.ENABLE:
                if state is State.OPERATION_ENABLED:
                    self._enter(Phase.CENTRE)
                return HOLD
            case Phase.CENTRE:
                return self._centre(drives, then=Phase.RISE)
            case Phase.RISE:
                return self._get_up(dt, roll)
            case Phase.SETTLE | Phase.EXCITE | Phase.FADE:
                return self._balance(dt, roll, drives)
            case Phase.LOWER:
                return self._lower(dt, roll, drives)
            case Phase.CENTRE_BACK:
                return self._centre(drives, then=Phase.DISABLE)
            case _:
                if state is not State.OPERATION_ENABLED:
                    self.done = True
                return IDLE

    def _enter(self, phase: Phase) -> None:
        self.phase = phase
        self._phase_time = 0.0

    def _fail(self, reason: str, *, go_on: Phase) -> None:
        self.failure = self.failure or reason
        self._enter(go_on)

    def _time_out(self, timeout: float) -> None:
        reason = f"{self.phase.text}: not done within {timeout:g} s"
        if self.phase is Phase.DISABLE:
            self.failure = self.failure or reason
            self.done = True
        else:
            self._fail(reason, go_on=Phase.CENTRE_BACK if self.phase is Phase.LOWER else Phase.DISABLE)

    def _rest(self, roll: RollState) -> Command:
        if self._phase_time >= DURATIONS[Phase.REST]:
            off = abs(abs(roll.roll) - self._plan.support)
            if off > AT_REST_ROLL or abs(roll.roll_rate) > AT_REST_RATE:
                self._fail(
                    f"the vehicle does not rest on a support: roll is {degrees(roll.roll):.2f} deg at "
                    f"{degrees(roll.roll_rate):.2f} deg/s, the supports are at +-{degrees(self._plan.support):.2f} "
                    "deg. Check the supports, imu.axes and limits.support_deg",
                    go_on=Phase.DISABLE,
                )
            else:
                self._side = copysign(1.0, roll.roll)
                self._enter(Phase.ENABLE)
        return IDLE

    def _centre(self, drives: Measurement, then: Phase) -> Command:
        """Slowly, so that the torque stays well below what would lift the vehicle off its support."""
        if abs(drives.precession) < CENTRED:
            self._enter(then)
            return HOLD
        return Command(State.OPERATION_ENABLED, max(-CENTRE_RATE, min(CENTRE_RATE, -2.0 * drives.precession)))

    def _get_up(self, dt: float, roll: RollState) -> Command:
        rise = self._rise
        rate = rise.step(dt, roll.roll, roll.roll_rate)
        if rise.done:
            self._controller.reset(rate)
            self._enter(Phase.LOWER if self.end_reason else Phase.SETTLE)
        elif rise.failure:
            self._fail(rise.failure, go_on=Phase.CENTRE_BACK)
        return Command(State.OPERATION_ENABLED, rate, 0.0, rate)

    def _balance(self, dt: float, roll: RollState, drives: Measurement) -> Command:
        value = self._plan.excitation.value(self._phase_time) if self.phase is Phase.EXCITE else 0.0
        on_reference = self._plan.excitation.at is InjectionPoint.ROLL_REFERENCE
        rate = self._controller.step(
            roll.roll,
            roll.roll_rate,
            drives.precession_rate,
            drives.precession,
            value if on_reference else 0.0,
            dt,
            0.0 if on_reference else value,
        )
        if self._phase_time >= self._duration(self.phase):
            self._enter(_NEXT[self.phase])
        return Command(State.OPERATION_ENABLED, rate, self._controller.reference, value)

    def _lower(self, dt: float, roll: RollState, drives: Measurement) -> Command:
        if self._lowering is None:
            plan = self._plan
            travel = lowering_travel(plan.parameters, plan.support)
            side = lowering_side(self._side, drives.precession, travel, plan.precession_budget)
            self._lowering = Lowering(side * plan.support, self._controller)
        rate = self._lowering.step(dt, roll.roll, roll.roll_rate, drives.precession_rate, drives.precession)
        if self._lowering.done:
            self._enter(Phase.CENTRE_BACK)
        return Command(State.OPERATION_ENABLED, rate, self._lowering.reference)
