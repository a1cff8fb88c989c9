"""What closed the loop while a recording was made: the vehicle's controller, the excitation, and its gimbals' drives.

The controller is run over the recorded measurements first (vehicles.recorded), once with the excitation on the roll
reference and once on its output.

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
from vehicles.monocab.control.controller import RollController, design
from vehicles.monocab.control.roll_design import RollDesign
from vehicles.monocab.file import MonocabFile
from vehicles.monocab.identification.own import drive_lag
from vehicles.phases import Phase
from vehicles.recorded import Recorded, entered_at, recorded
from vehicles.sections import CONTROLLER_OUTPUT, is_reference

Array = NDArray[np.float64]

SETPOINT = "precession_rate_setpoint"
MEASURED = ("roll", "roll_rate", "precession_rate", "precession")
COMPARED = ("roll", "precession_rate")


@dataclass(frozen=True, slots=True)
class _Motion:
    """The gimbals' rate and angle at the instants of the rows, and the rows by which a setpoint is on its way."""

    rate: list[float]
    precession: list[float]
    late: int


def recorded_loop(vehicle: MonocabFile, recording: Recording) -> Loop | str:
    """The loop of `recording` from the first row of its excitation on, or why it is not known, in words."""
    time = recording.time
    period = float(np.median(np.diff(time))) if len(time) > 1 else vehicle.period
    told = recorded(recording, (*MEASURED, SETPOINT), since=Phase.SETTLE, period=period)
    if isinstance(told, str):
        return told
    held = (recording["phase"] >= Phase.SETTLE) & (recording["phase"] <= Phase.FADE)
    age = recording["drive_age"]
    sent = recording.values.get("setpoint_age", np.zeros(len(recording)))[held]
    if not (sent <= 0.0).all():
        return "the recording does not say when its setpoints left, or before they were computed: setpoint_age"
    try:
        gains = design(vehicle)
        at = entered_at(
            ("roll_reference", CONTROLLER_OUTPUT),
            lambda at: [_replayed(vehicle, gains, told, at, told.last)[1]],
            told,
            (SETPOINT,),
        )
        if at is None:
            return f"the controller of {vehicle.vehicle.id}'s vehicle file does not give the recorded setpoints"
        drives = drive_lag([recording]).parameters
    except UprightError as error:
        return f"the loop cannot be made: {error}"
    unknown = next((each.reason for each in drives.values() if each.value is None), None)
    if unknown is not None:
        return f"the speed loop of the gimbals' drives does not show: {unknown}"
    lag, offset, reaction = (float(each.value or 0.0) for each in drives.values())
    whole, offset = divmod(-float(np.median(sent)) + min(max(offset, 0.0), told.period), told.period)
    motion = _Motion(
        rate=np.interp(time, time - age, recording["precession_rate"]).tolist(),
        precession=np.interp(time, time - age, recording["precession"]).tolist(),
        late=int(whole),
    )
    drive = partial(SpeedLoopSteps, lag, offset, reaction, told.period)
    return Loop(
        begins=told.time[told.first],
        ends=told.time[told.last],
        controller=partial(_loop, vehicle, gains, told, at, drive, motion),
        needs=frozenset({"roll", "roll_rate"}),
        gives=frozenset({"precession_rate_setpoint", "precession_rate", "precession"}),
        channels=COMPARED,
    )


def _replayed(
    vehicle: MonocabFile, gains: RollDesign, told: Recorded, at: str, until: int
) -> tuple[RollController, list[float]]:
    """The controller before row `until`, run over the recorded measurements, and the setpoints it gave."""
    controller = RollController.from_design(gains, vehicle)
    controller.reset(told.values[SETPOINT][told.held])
    measured = [told.values[name] for name in MEASURED]
    rows = range(told.held + 1, until)
    return controller, [_step(controller, told, at, row, *(each[row] for each in measured)) for row in rows]


def _step(
    controller: RollController,
    told: Recorded,
    at: str,
    row: int,
    roll: float,
    roll_rate: float,
    rate: float,
    precession: float,
) -> float:
    value = told.values["excitation"][row]
    on_reference = is_reference(at)
    dt = told.time[row] - told.time[row - 1]
    reference, output = (value, 0.0) if on_reference else (0.0, value)
    return controller.step(roll, roll_rate, rate, precession, reference, dt, output)


def _loop(
    vehicle: MonocabFile,
    gains: RollDesign,
    told: Recorded,
    at: str,
    make_drive: partial[SpeedLoopSteps],
    motion: _Motion,
) -> Controller:
    """The controller and the drives as they were at the first excited row."""
    controller, _ = _replayed(vehicle, gains, told, at, told.first)
    sent, rolled = told.values[SETPOINT], told.values["roll_rate"]
    begin = max(0, told.first - round(RUN_IN / told.period))
    drive = make_drive(setpoint=sent[begin])
    under_way = deque([sent[begin]] * motion.late)
    for row in range(begin, told.first):
        under_way.append(sent[row])
        drive.step(under_way.popleft(), rolled[row])
    rates, angles = motion.rate[: told.first + 1], motion.precession[: told.first + 1]
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
