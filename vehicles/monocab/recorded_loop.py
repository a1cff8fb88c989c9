"""What closed the loop while a recording was made: the vehicle's controller, the excitation, and its axes' drives.

What balances the vehicle in an experiment (vehicles.monocab.handling) is first replayed on the recorded measurements
(vehicles.experiment.recorded): the reduced controller, or the full one if the trim mass was moved, with the excitation
on the roll reference or on the output.

For models to which the motion of gimbals and trim mass is an input, the drives' speed loops are those identified from
the recording (estimators.methods.drive_lag). If a setpoint acts later than one control cycle after its sample, this is
a delay and not a property of the drive: it is left out here, and belongs to the model. If the model has one of its
actuators (models.model.Model.actuators_model), these move as that says, with the effects on the way of the setpoints.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from operator import attrgetter
from typing import Self

import numpy as np
from numpy.typing import NDArray

from upright.diagnosis.prediction.actuator_motion import ActuatorMotion, motion_of
from upright.diagnosis.prediction.closed_loop import Controller
from upright.diagnosis.prediction.closed_loop_error import Loop
from upright.estimators.contract import Estimate
from upright.estimators.speed_loop import RUN_IN
from upright.estimators.speed_loop_steps import SpeedLoopSteps
from upright.models.control_design.robustness import CheckedDesign
from upright.models.model import Model
from upright.telemetry.errors import UprightError
from upright.telemetry.recording import Recording
from upright.vehicles.contract import Command, Lean
from upright.vehicles.experiment.excitation import Excitation, Nothing
from upright.vehicles.experiment.phases import Phase
from upright.vehicles.experiment.recorded import Recorded, entered_at, recorded
from upright.vehicles.monocab.axes import GimbalMeasurement
from upright.vehicles.monocab.control.controller import design
from upright.vehicles.monocab.control.full import design_full
from upright.vehicles.monocab.control.linear_model import MonocabParameters
from upright.vehicles.monocab.control.roll_design import RollDesign
from upright.vehicles.monocab.file import FULL, REDUCED, ROLL_REFERENCE, TRIM_RATE, MonocabFile
from upright.vehicles.monocab.handling import GimbalHandling
from upright.vehicles.monocab.identification.own import drive_lag, trim_drive_lag
from upright.vehicles.sections import CONTROLLER_OUTPUT

POINTS = (ROLL_REFERENCE, CONTROLLER_OUTPUT)
"""Where an excitation may enter that leaves the trim mass to the controller."""

Array = NDArray[np.float64]
Follow = Callable[[float, Mapping[str, float]], float]
"""From the setpoint that is sent at a sample, and what is seen there, to the axis' rate at the next sample."""


@dataclass(frozen=True, slots=True)
class _Axis:
    """The channels of an axis: its `setpoint`, its `rate` and its `position`; `speed_loop` identifies its drive,
    whose `lag` the vehicle file states, s."""

    setpoint: str
    rate: str
    position: str
    speed_loop: Callable[[Sequence[Recording]], Estimate]
    lag: Callable[[MonocabParameters], float]


GIMBALS = _Axis("precession_rate_setpoint", "precession_rate", "precession", drive_lag, attrgetter("speed_loop_lag"))
TRIM = _Axis("trim_rate_setpoint", "trim_rate", "trim_position", trim_drive_lag, attrgetter("trim_lag"))
MEASURED = ("roll", "roll_rate", *(channel for axis in (GIMBALS, TRIM) for channel in (axis.rate, axis.position)))


@dataclass(frozen=True, slots=True)
class _Drive:
    """The drive of an axis as identified: `loop` makes its speed loop, in steady state at `setpoint`, and a setpoint is
    under way for `late` samples. Setpoints were `sent` s after their samples. `rate` and `position` are the recorded
    ones at the sampling instants."""

    axis: _Axis
    sent: float
    loop: partial[SpeedLoopSteps]
    late: int
    rate: list[float]
    position: list[float]


@dataclass(frozen=True, slots=True)
class _Balancing:
    """What balanced the vehicle: one of its controllers, with the excitation entering `at` an injection point.
    `trimming`: the trim mass moved, too."""

    vehicle: MonocabFile
    reduced: RollDesign
    full: CheckedDesign | None
    trimming: bool

    def handling(self, at: str) -> GimbalHandling:
        """Upright, with the controllers not yet running."""
        silent = Excitation(at, 0.0, 1.0, 0.0, Nothing())
        return GimbalHandling.of(self.vehicle, self.reduced, self.full, silent, FULL if self.full else REDUCED)

    @property
    def driven(self) -> tuple[_Axis, ...]:
        """The axes that it moves."""
        return (GIMBALS, TRIM) if self.trimming else (GIMBALS,)


def recorded_loop(vehicle: MonocabFile, recording: Recording) -> Loop | str:
    """The loop of `recording` from the first sample of its excitation on, or why it is not known, in words."""
    time = recording.time
    period = float(np.median(np.diff(time))) if len(time) > 1 else vehicle.period
    channels = (*MEASURED, GIMBALS.setpoint, TRIM.setpoint)
    record = recorded(recording, channels, since=Phase.SETTLE, period=period, longest=vehicle.longest_silence)
    if isinstance(record, str):
        return record
    held = (recording["phase"] >= Phase.SETTLE) & (recording["phase"] <= Phase.FADE)
    sent = recording.values.get("setpoint_age", np.zeros(len(recording)))[held]
    if not (sent <= 0.0).all():
        return "setpoint_age is unknown, or positive as if setpoints had left before they were computed"
    try:
        found = _what_balanced(vehicle, record, trimming=bool(np.any(recording[TRIM.setpoint][held])))
        if found is None:
            return f"the controller of {vehicle.vehicle.id}'s vehicle file does not give the recorded setpoints"
        balancing, at = found
        drives = [
            _identified(axis, recording, record, -float(np.median(sent)), axis.lag(balancing.reduced.parameters))
            for axis in balancing.driven
        ]
    except UprightError as error:
        return f"the loop cannot be reconstructed: {error}"
    return Loop(
        begins=record.time[record.first],
        ends=record.time[record.last],
        controller=lambda model: partial(_loop, balancing, record, at, drives, model),
        needs=frozenset({"roll", "roll_rate"}),
        gives=frozenset(channel for axis in balancing.driven for channel in (axis.setpoint, axis.rate, axis.position)),
        channels=("roll", "precession", "trim_position") if balancing.full else ("roll", "precession_rate"),
    )


def _what_balanced(vehicle: MonocabFile, record: Recorded, *, trimming: bool) -> tuple[_Balancing, str] | None:
    """The controller that gives the recorded setpoints, and where the excitation entered; None if none of them does.
    The full one moves the trim mass; if only the excitation does, it is the reduced one."""
    reduced = design(vehicle)
    alone: tuple[str, ...] = (TRIM_RATE,) if trimming else POINTS
    candidates = [(_Balancing(vehicle, reduced, None, trimming), alone)]
    if trimming:
        candidates.append((_Balancing(vehicle, reduced, design_full(vehicle), trimming), (*POINTS, TRIM_RATE)))
    for balancing, points in candidates:

        def given(at: str, balancing: _Balancing = balancing) -> Array:
            return _replayed(balancing, record, at, record.last)[1]

        at = entered_at(points, given, record, [axis.setpoint for axis in balancing.driven])
        if at is not None:
            return balancing, at
    return None


def _identified(axis: _Axis, recording: Recording, record: Recorded, sent: float, stated: float) -> _Drive:
    """The drive of `axis`, whose setpoints were sent `sent` s after their samples. If the recording does not identify
    it, it has the lag that the vehicle file has `stated`, s.

    Raises RecordingError.
    """
    found: Estimate = axis.speed_loop([recording])
    identified = [each.value for each in found.parameters.values() if each.value is not None]
    lag, offset, *reaction = identified if len(identified) == len(found.parameters) else [stated, 0.0]
    whole, offset = divmod(sent + min(max(offset, 0.0), record.period), record.period)
    time, age = recording.time, recording["drive_age"]
    return _Drive(
        axis,
        sent,
        partial(SpeedLoopSteps, lag, offset, reaction[0] if reaction else 0.0, record.period),
        int(whole),
        rate=np.interp(time, time - age, recording[axis.rate]).tolist(),
        position=np.interp(time, time - age, recording[axis.position]).tolist(),
    )


def _replayed(balancing: _Balancing, record: Recorded, at: str, until: int) -> tuple[GimbalHandling, Array]:
    """What balances, as it was before sample `until`, replayed on the recorded measurements, and the setpoints of the
    axes it moves, (axes, samples)."""
    handling = balancing.handling(at)
    handling.stand(record.values[GIMBALS.setpoint][record.held])
    measured = [record.values[name] for name in MEASURED]
    sent = []
    for row in range(record.held + 1, until):
        command = _step(handling, record, row, [each[row] for each in measured])
        sent.append((command.setpoint, *(command.others or (0.0,)))[: len(balancing.driven)])
    return handling, np.array(sent).reshape(-1, len(balancing.driven)).T


def _step(handling: GimbalHandling, record: Recorded, row: int, measured: list[float]) -> Command:
    """The command at sample `row`; `measured` in the order of MEASURED."""
    roll, roll_rate, precession_rate, precession, trim_rate, trim_position = measured
    drives = GimbalMeasurement(0, precession, precession_rate, 0.0, trim_position, trim_rate)
    return handling.balance(record.elapsed(row), Lean(roll, roll_rate), drives, record.values["excitation"][row])


class _Motion:
    """An axis in the loop: how it follows its setpoints, its rate and position at the samples so far."""

    def __init__(self, drive: _Drive, follow: Follow, first: int) -> None:
        self._axis, self._follow = drive.axis, follow
        self._rates, self._positions = drive.rate[: first + 1], drive.position[: first + 1]

    @classmethod
    def before(cls, drive: _Drive, record: Recorded, first: int, model: Model) -> Self:
        """As it was before sample `first`, by the model of the actuators that belongs to `model` if there is one."""
        sent, rolled = record.values[drive.axis.setpoint], record.values["roll_rate"]
        begin = max(0, first - round(RUN_IN / record.period))
        actuators = motion_of(model, drive.axis.setpoint)
        if actuators is None:
            follow = _identified_drive(drive, sent[begin])
        else:
            follow = _modelled_drive(drive, actuators, record.period, record.last + 1 - begin, sent[begin])
        for row in range(begin, first):
            follow(sent[row], {"roll_rate": rolled[row]})
        return cls(drive, follow, first)

    def reported(self, row: int, seen: Mapping[str, float], age: float) -> list[float]:
        """Rate and position as the drive reports them at sample `row`, `age` samples old. If the drives are sampled
        after the IMU, they are extrapolated linearly from this sample."""
        axis = self._axis
        self._rates[row] = seen.get(axis.rate, self._rates[row])
        self._positions[row] = seen.get(axis.position, self._positions[row])
        whole = max(0, int(age))
        back, part = row - whole, age - whole
        return [each[back] + part * (each[back - 1] - each[back]) for each in (self._rates, self._positions)]

    def go_on(self, row: int, seen: Mapping[str, float], setpoint: float, period: float) -> dict[str, float]:
        """The inputs that follow from `setpoint`, sent at sample `row`: rate and position at the next one."""
        axis, rates, positions = self._axis, self._rates, self._positions
        following = self._follow(setpoint, seen)
        # A model with drives of its own gives their rate; up to the next sample it is extrapolated linearly.
        rates.append(2.0 * rates[row] - rates[row - 1] if axis.rate in seen else following)
        positions.append(positions[row] + 0.5 * period * (rates[row] + rates[row + 1]))
        return {axis.setpoint: setpoint, axis.rate: rates[row + 1], axis.position: positions[row + 1]}


def _identified_drive(drive: _Drive, setpoint: float) -> Follow:
    """By its speed loop, in steady state at `setpoint`."""
    loop, under_way = drive.loop(setpoint=setpoint), deque([setpoint] * drive.late)

    def follow(sent: float, seen: Mapping[str, float]) -> float:
        under_way.append(sent)
        return loop.step(under_way.popleft(), seen["roll_rate"])

    return follow


def _modelled_drive(drive: _Drive, actuators: Model, period: float, samples: int, setpoint: float) -> Follow:
    """By a model of the `actuators`, for so many `samples` after those at `setpoint`."""
    motion = ActuatorMotion(actuators, period, samples, setpoint, drive.sent)
    return lambda sent, seen: motion.step(sent, seen)[drive.axis.rate]


def _loop(
    balancing: _Balancing, record: Recorded, at: str, drives: list[_Drive], model: Model, begins: float
) -> Controller:
    """The controller and the drives in their state at the sample at `begins` s."""
    first = record.row(begins)
    handling, _ = _replayed(balancing, record, at, first)
    motions = [_Motion.before(drive, record, first, model) for drive in drives]
    still = [record.values[name] for name in (TRIM.rate, TRIM.position)]
    row = first - 1

    def step(time: float, seen: Mapping[str, float]) -> Mapping[str, float]:
        nonlocal row
        row += 1
        age = record.values["drive_age"][row] / record.period
        reported = [value for motion in motions for value in motion.reported(row, seen, age)]
        if len(motions) == 1:
            reported += [each[row] for each in still]
        command = _step(handling, record, row, [seen["roll"], seen["roll_rate"], *reported])
        given: dict[str, float] = {}
        for motion, setpoint in zip(motions, (command.setpoint, *command.others), strict=False):
            given |= motion.go_on(row, seen, setpoint, record.period)
        return given

    return step
