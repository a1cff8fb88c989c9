"""The phases of an experiment, from rest on a support back to rest on a support. Pure.

    rest -> enable -> centre -> rise -> settle -> excite -> fade -> lower -> centre back -> disable
    rest -> enable -> centre -> move -> centre back -> disable        if it stays on its support
    rest -> disable                                                   if its drives stay off

Each experiment has one verb, one recording, and ends in a state in which the vehicle may be touched.
`ExperimentRun.step` is called once per control cycle and returns the command for the drives. It is independent of bus
and clock and only uses the time of the samples. The phases are the same for every vehicle; rising, balancing and
lowering depend on the kind of vehicle (`vehicles.contract.Handling`).
"""

from __future__ import annotations

from dataclasses import dataclass
from math import degrees
from typing import Any

from upright.drivers.cia402.states import State
from upright.vehicles.contract import HOLD, IDLE, Command, Handling, Lean, Pilot
from upright.vehicles.experiment.excitation import Excitation, make_excitation
from upright.vehicles.experiment.phases import DURATIONS, TIMEOUTS, UPRIGHT, Phase
from upright.vehicles.sections import REST, Asked, VehicleFile

AT_REST_ANGLE = 0.0175
"""rad (1 deg): tolerance of the angle for resting on a support."""

AT_REST_RATE = 0.01
"""rad/s: tolerance of the rate of that angle."""

SILENCE_AFTER = 1.0
"""s of holding still before a silence begins."""


_UP = (Phase.RISE, Phase.SETTLE, Phase.EXCITE, Phase.FADE, Phase.LOWER)
_NEXT = {Phase.SETTLE: Phase.EXCITE, Phase.EXCITE: Phase.FADE, Phase.FADE: Phase.LOWER}


@dataclass(frozen=True, slots=True)
class Plan:
    """The parts of an experiment. `support` in rad; `angle` is the name of the angle of the fall; `asks` is what a
    person does to the vehicle, if anything. `gets_up`: it leaves its support; `powered`: its drives are on; `silence`:
    s without setpoints and heartbeat."""

    excitation: Excitation
    handling: Handling[Any]
    support: float
    angle: str
    asks: Asked | None
    gets_up: bool
    powered: bool
    silence: float


def plan(vehicle: VehicleFile, experiment: str, pilot: Pilot[Any], angle: str) -> Plan:
    """The plan of a vehicle file's experiment.

    Raises ExcitationError if the experiment's signal cannot be generated.
    """
    section = vehicle.experiments[experiment]
    excitation = make_excitation(section, float(vehicle.control.rate))
    return Plan(
        excitation,
        pilot.handling(excitation, section.controller),
        vehicle.support,
        angle,
        section.asks,
        gets_up=section.gets_up,
        powered=section.gets_up or section.at != REST,
        silence=(section.width or 0.0) if section.excitation == "silence" else 0.0,
    )


class ExperimentRun:
    """The course of one experiment. `done` when it has ended; `failure` is the reason if it did not succeed; `asked` is
    what a person has been asked to do, from its time on until the end, None before."""

    def __init__(self, name: str, plan: Plan) -> None:
        self.name = name
        self.phase = Phase.REST
        self.failure = ""
        self.end_reason = ""
        self.done = False
        self.asked: Asked | None = None
        self._plan = plan
        self._handling = plan.handling
        self._phase_time = 0.0

    @property
    def fraction(self) -> float:
        """Elapsed share of the expected time, 0 to 1; phases of unknown length are not counted."""
        course = self._course
        if self.phase not in course:
            return 0.0 if self.phase < Phase.RISE else 1.0
        before = sum(self._duration(phase) for phase in course[: course.index(self.phase)])
        return min(1.0, (before + (self._phase_time if self._is_timed(self.phase) else 0.0)) / self._expected)

    @property
    def remaining(self) -> float:
        """Approximate remaining time, s."""
        return (1.0 - self.fraction) * self._expected

    @property
    def silent(self) -> bool:
        """Whether setpoints and heartbeat are withheld now."""
        return self.phase is Phase.MOVE and 0.0 <= self._phase_time - SILENCE_AFTER < self._plan.silence

    @property
    def leaves_drives_alone(self) -> bool:
        """Whether the drives may be in any state: they have been without setpoints, or may have been."""
        late = self.phase is Phase.MOVE and self._phase_time >= SILENCE_AFTER
        return self._plan.silence > 0.0 and (late or self.phase is Phase.DISABLE)

    @property
    def _course(self) -> tuple[Phase, ...]:
        """The phases of this experiment, in order."""
        if not self._plan.powered:
            return (Phase.REST, Phase.DISABLE)
        between = _UP if self._plan.gets_up else (Phase.MOVE,)
        return (Phase.REST, Phase.ENABLE, Phase.CENTRE, *between, Phase.CENTRE_BACK, Phase.DISABLE)

    @property
    def _expected(self) -> float:
        return sum(self._duration(phase) for phase in self._course)

    def _is_timed(self, phase: Phase) -> bool:
        return phase in DURATIONS or phase in (Phase.EXCITE, Phase.MOVE)

    def _duration(self, phase: Phase) -> float:
        """s that the phase lasts; 0 if that is not known before."""
        if phase in (Phase.EXCITE, Phase.MOVE):
            return self._plan.excitation.duration
        at_rest = self._plan.excitation.duration if phase is Phase.REST and not self._plan.powered else 0.0
        return DURATIONS.get(phase, 0.0) + at_rest

    def end(self, reason: str) -> None:
        """End early and in order: if the vehicle is up, it is lowered first."""
        if self.end_reason or self.done:
            return
        self.end_reason = reason
        if self.phase in (Phase.REST, Phase.ENABLE, Phase.CENTRE):
            self._enter(Phase.DISABLE)
        elif self.phase is Phase.MOVE:
            self._enter(Phase.CENTRE_BACK)
        elif self.phase in UPRIGHT:
            self._enter(Phase.LOWER)

    def step(self, dt: float, lean: Lean, drives: Any, state: State | None) -> Command:
        """The command of this cycle. `dt` s since the last one; `state` is that of all drives, None if they differ.

        `drives` are the measurements of this kind of vehicle.
        """
        self._phase_time += dt
        timeout = TIMEOUTS.get(self.phase)
        if timeout is not None and self._phase_time > timeout:
            self._time_out(timeout)
        match self.phase:
            case Phase.REST:
                return self._rest(lean)
            case Phase.ENABLE:
                if state is State.OPERATION_ENABLED:
                    self._enter(Phase.CENTRE)
                return HOLD
            case Phase.CENTRE:
                return self._centre(drives, then=Phase.RISE if self._plan.gets_up else Phase.MOVE)
            case Phase.MOVE:
                return self._move(dt, drives)
            case Phase.RISE:
                return self._get_up(dt, lean, drives)
            case Phase.SETTLE | Phase.EXCITE | Phase.FADE:
                return self._balance(dt, lean, drives)
            case Phase.LOWER:
                return self._lower(dt, lean, drives)
            case Phase.CENTRE_BACK:
                return self._centre(drives, then=Phase.DISABLE)
            case _:
                # A drive that has lost its master may not report its state any more; it is set up again afterwards.
                if state is not State.OPERATION_ENABLED or self._plan.silence:
                    self.done = True
                return IDLE

    def _enter(self, phase: Phase) -> None:
        self.phase = phase
        self._phase_time = 0.0

    def _fail(self, reason: str, *, go_on: Phase) -> None:
        self.failure = self.failure or reason
        self._enter(go_on)

    def _time_out(self, timeout: float) -> None:
        reason = f"{self.phase.text}: not completed within {timeout:g} s"
        if self.phase is Phase.DISABLE:
            self.failure = self.failure or reason
            self.done = True
        else:
            self._fail(reason, go_on=Phase.CENTRE_BACK if self.phase is Phase.LOWER else Phase.DISABLE)

    def _rest(self, lean: Lean) -> Command:
        if not self._plan.powered:
            self._ask(self._phase_time - DURATIONS[Phase.REST])
            if self._phase_time >= self._duration(Phase.REST):
                self._enter(Phase.DISABLE)
        elif self._phase_time >= DURATIONS[Phase.REST]:
            off = abs(abs(lean.angle) - self._plan.support)
            if off > AT_REST_ANGLE or abs(lean.rate) > AT_REST_RATE:
                self._fail(
                    f"the vehicle does not rest on a support: {self._plan.angle} is {degrees(lean.angle):.2f} deg at "
                    f"{degrees(lean.rate):.2f} deg/s, the supports are at ±{degrees(self._plan.support):.2f} "
                    "deg. Check the supports, imu.axes and limits.support_deg",
                    go_on=Phase.DISABLE,
                )
            else:
                self._enter(Phase.ENABLE)
        return IDLE

    def _ask(self, time: float) -> None:
        """Ask a person for what the experiment wants, once its time has come; `time` s since the start."""
        asks = self._plan.asks
        if asks is not None and time >= asks.after:
            self.asked = asks

    def _move(self, dt: float, drives: Any) -> Command:
        """On the support: follow the excitation, or hold still and be silent."""
        command = self._handling.move(dt, drives, self._plan.excitation.value(self._phase_time))
        if self._phase_time >= self._plan.excitation.duration:
            self._enter(Phase.DISABLE if self._plan.silence else Phase.CENTRE_BACK)
        return IDLE if self.leaves_drives_alone else command

    def _centre(self, drives: Any, then: Phase) -> Command:
        command = self._handling.centre(drives)
        if command is None:
            self._enter(then)
            return HOLD
        return command

    def _get_up(self, dt: float, lean: Lean, drives: Any) -> Command:
        handling = self._handling
        command = handling.rise(dt, lean, drives)
        if handling.risen:
            self._enter(Phase.LOWER if self.end_reason else Phase.SETTLE)
        elif handling.failure:
            self._fail(handling.failure, go_on=Phase.CENTRE_BACK)
        return command

    def _balance(self, dt: float, lean: Lean, drives: Any) -> Command:
        value = 0.0
        if self.phase is Phase.EXCITE:
            value = self._plan.excitation.value(self._phase_time)
            self._ask(self._phase_time)
        command = self._handling.balance(dt, lean, drives, value)
        if self._phase_time >= self._duration(self.phase):
            self._enter(_NEXT[self.phase])
        return command

    def _lower(self, dt: float, lean: Lean, drives: Any) -> Command:
        command = self._handling.lower(dt, lean, drives)
        if self._handling.lowered:
            self._enter(Phase.CENTRE_BACK)
        return command
