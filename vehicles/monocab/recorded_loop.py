"""What closed the loop while a recording was made: the vehicle's controller, the excitation, and its gimbals' drives.

The controller is run over the recorded measurements first, once with the excitation on the roll reference and once on
its output: where one of them gives the recorded setpoints, this is the controller that was there, and it is known as it
was at any row. So the recording needs no metadata; one of another vehicle or of other software is found out.

The drives' speed loops are as the recording shows them (estimators.methods.drive_lag), for models to which the gimbals'
motion is an input. A setpoint that acts later than one control cycle after its row is a delay, and no property of a
drive: it is left out here, for the model to have it.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from diagnosis.prediction.closed_loop import Controller
from diagnosis.prediction.closed_loop_error import Loop
from estimators.speed_loop import RUN_IN
from estimators.speed_loop_steps import SpeedLoopSteps
from telemetry.errors import UprightError
from telemetry.recording import Recording
from vehicles.excitation import InjectionPoint
from vehicles.monocab.control.controller import RollController, design
from vehicles.monocab.control.roll_design import RollDesign
from vehicles.monocab.file import MonocabFile
from vehicles.monocab.identification.own import drive_lag
from vehicles.phases import Phase

Array = NDArray[np.float64]

MEASURED = ("roll", "roll_rate", "precession_rate", "precession")
CHANNELS = (*MEASURED, "precession_rate_setpoint", "drive_age", "excitation", "phase")
"""Without which the loop is not known."""
COMPARED = ("roll", "precession_rate")
SAME = 0.01
"""Share of the setpoints' RMS by which the controller may differ from the recorded ones: some rows may be lost."""


@dataclass(frozen=True, slots=True)
class _Recorded:
    """A recording as lists, for loops; rows `balance` on the controller held the vehicle, from `first` on excited."""

    values: Mapping[str, list[float]]
    time: list[float]
    latency: float
    """s from the row to its setpoints."""
    rate: list[float]
    precession: list[float]
    period: float
    balance: int
    first: int
    last: int


def recorded_loop(vehicle: MonocabFile, recording: Recording) -> Loop | str:
    """The loop of `recording` from the first row of its excitation on, or why it is not known, in words."""
    lacking = [name for name in CHANNELS if name not in recording.values]
    if lacking:
        return f"the recording has no channel {', '.join(lacking)}: what drove the controller is not known"
    phase, excitation = recording["phase"], recording["excitation"]
    if not np.isfinite(excitation).any() or not np.isfinite(phase).any():
        return "the recording does not hold the excitation, as one from a raw CAN log: take the .arrow beside it"
    held = np.flatnonzero((phase >= Phase.SETTLE) & (phase <= Phase.FADE))
    excited = np.flatnonzero((phase >= Phase.EXCITE) & (phase <= Phase.FADE) & np.isfinite(excitation))
    if not len(excited) or not np.any(excitation[excited]):
        return "nothing excites the vehicle while its controller holds it up"
    if held[0] == 0 or phase[held[0]] == Phase.EXCITE:
        return "the recording begins later than the controller: its state is not known"
    if not all(np.isfinite(recording[name][held]).all() for name in CHANNELS):
        return "the recording has unknown values while the controller holds the vehicle up"
    time, age = recording.time, recording["drive_age"]
    sent = recording.values.get("setpoint_age", np.zeros(len(recording)))[held]
    if not (sent <= 0.0).all():
        return "the recording does not say when its setpoints left, or before they were computed: setpoint_age"
    told = _Recorded(
        values={name: recording[name].tolist() for name in CHANNELS},
        time=time.tolist(),
        latency=-float(np.median(sent)),
        rate=np.interp(time, time - age, recording["precession_rate"]).tolist(),
        precession=np.interp(time, time - age, recording["precession"]).tolist(),
        period=float(np.median(np.diff(time))),
        balance=int(held[0]),
        first=int(excited[0]),
        last=int(excited[-1]),
    )
    try:
        gains = design(vehicle)
        at = _injection(vehicle, gains, told)
        if at is None:
            return f"the controller of {vehicle.vehicle.id}'s vehicle file does not give the recorded setpoints"
        drives = drive_lag([recording]).parameters
    except UprightError as error:
        return f"the loop cannot be made: {error}"
    unknown = next((each.reason for each in drives.values() if each.value is None), None)
    if unknown is not None:
        return f"the speed loop of the gimbals' drives does not show: {unknown}"
    lag, offset, reaction = (float(each.value or 0.0) for each in drives.values())
    whole, offset = divmod(told.latency + min(max(offset, 0.0), told.period), told.period)
    drive = partial(SpeedLoopSteps, lag, offset, reaction, told.period)
    return Loop(
        begins=told.time[told.first],
        ends=told.time[told.last],
        controller=partial(_loop, vehicle, gains, told, at, drive, int(whole)),
        needs=frozenset({"roll", "roll_rate"}),
        gives=frozenset({"precession_rate_setpoint", "precession_rate", "precession"}),
        channels=COMPARED,
    )


def _injection(vehicle: MonocabFile, gains: RollDesign, told: _Recorded) -> InjectionPoint | None:
    """Where the excitation enters, so that the controller gives the recorded setpoints; None where it does not."""
    sent = told.values["precession_rate_setpoint"]
    for at in (InjectionPoint.ROLL_REFERENCE, InjectionPoint.CONTROLLER_OUTPUT):
        given = _replayed(vehicle, gains, told, at, told.last)[1]
        errors = np.array(given) - sent[told.balance + 1 : told.last]
        if np.sqrt(np.mean(errors**2)) < SAME * np.sqrt(np.mean(np.square(sent[told.balance : told.last]))):
            return at
    return None


def _replayed(
    vehicle: MonocabFile, gains: RollDesign, told: _Recorded, at: InjectionPoint, until: int
) -> tuple[RollController, list[float]]:
    """The controller before row `until`, run over the recorded measurements, and the setpoints it gave."""
    controller = RollController.from_design(gains, vehicle)
    controller.reset(told.values["precession_rate_setpoint"][told.balance])
    measured = [told.values[name] for name in MEASURED]
    rows = range(told.balance + 1, until)
    return controller, [_step(controller, told, at, row, *(each[row] for each in measured)) for row in rows]


def _step(
    controller: RollController,
    told: _Recorded,
    at: InjectionPoint,
    row: int,
    roll: float,
    roll_rate: float,
    rate: float,
    precession: float,
) -> float:
    value = told.values["excitation"][row]
    on_reference = at is InjectionPoint.ROLL_REFERENCE
    dt = told.time[row] - told.time[row - 1]
    reference, output = (value, 0.0) if on_reference else (0.0, value)
    return controller.step(roll, roll_rate, rate, precession, reference, dt, output)


def _loop(
    vehicle: MonocabFile,
    gains: RollDesign,
    told: _Recorded,
    at: InjectionPoint,
    make_drive: partial[SpeedLoopSteps],
    late: int,
) -> Controller:
    """The controller and the drives as they were at the first excited row. Setpoints are `late` rows on their way."""
    controller, _ = _replayed(vehicle, gains, told, at, told.first)
    sent, rolled = told.values["precession_rate_setpoint"], told.values["roll_rate"]
    begin = max(0, told.first - round(RUN_IN / told.period))
    drive = make_drive(setpoint=sent[begin])
    under_way = deque([sent[begin]] * late)
    for row in range(begin, told.first):
        under_way.append(sent[row])
        drive.step(under_way.popleft(), rolled[row])
    rates, angles = told.rate[: told.first + 1], told.precession[: told.first + 1]
    row = told.first - 1

    def step(time: float, seen: Mapping[str, float]) -> Mapping[str, float]:
        nonlocal row
        row += 1
        rates[row] = seen.get("precession_rate", rates[row])
        angles[row] = seen.get("precession", angles[row])
        age = told.values["drive_age"][row] / told.period
        # Drives that are sampled after the IMU went on from this row as before.
        whole = max(0, int(age))
        back, part = row - whole, age - whole
        setpoint = _step(
            controller,
            told,
            at,
            row,
            seen["roll"],
            seen["roll_rate"],
            rates[back] + part * (rates[back - 1] - rates[back]),
            angles[back] + part * (angles[back - 1] - angles[back]),
        )
        under_way.append(setpoint)
        following = drive.step(under_way.popleft(), seen["roll_rate"])
        # A model with drives of its own shows its rate; until the next row it goes on as before.
        rates.append(2.0 * rates[row] - rates[row - 1] if "precession_rate" in seen else following)
        angles.append(angles[row] + 0.5 * told.period * (rates[row] + rates[row + 1]))
        return {
            "precession_rate_setpoint": setpoint,
            "precession_rate": rates[row + 1],
            "precession": angles[row + 1],
        }

    return step
