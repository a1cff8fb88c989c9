"""What closed the loop while a recording was made: the vehicle's controller, the excitation, and its gimbals' drives.

The controller is first replayed on the recorded measurements (vehicles.recorded), once with the excitation on the roll
reference and once on its output.

For models to which the gimbals' motion is an input, the drives' speed loops are those identified from the recording
(estimators.methods.drive_lag). If a setpoint acts later than one control cycle after its sample, this is a delay and
not a property of the drive: it is left out here, and belongs to the model.
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
    """The gimbals' rate and angle at the sampling instants, and the delay of a setpoint in samples."""

    rate: list[float]
    precession: list[float]
    late: int


def recorded_loop(vehicle: MonocabFile, recording: Recording) -> Loop | str:
    """The loop of `recording` from the first sample of its excitation on, or why it is not known, in words."""
    time = recording.time
    period = float(np.median(np.diff(time))) if len(time) > 1 else vehicle.period
    record = recorded(recording, (*MEASURED, SETPOINT), since=Phase.SETTLE, period=period)
    if isinstance(record, str):
        return record
    held = (recording["phase"] >= Phase.SETTLE) & (recording["phase"] <= Phase.FADE)
    age = recording["drive_age"]
    sent = recording.values.get("setpoint_age", np.zeros(len(recording)))[held]
    if not (sent <= 0.0).all():
        return "setpoint_age is unknown, or positive as if setpoints had left before they were computed"
    try:
        gains = design(vehicle)
        at = entered_at(
            ("roll_reference", CONTROLLER_OUTPUT),
            lambda at: [_replayed(vehicle, gains, record, at, record.last)[1]],
            record,
            (SETPOINT,),
        )
        if at is None:
            return f"the controller of {vehicle.vehicle.id}'s vehicle file does not give the recorded setpoints"
        drives = drive_lag([recording]).parameters
    except UprightError as error:
        return f"the loop cannot be reconstructed: {error}"
    unknown = next((each.reason for each in drives.values() if each.value is None), None)
    if unknown is not None:
        return f"the speed loop of the gimbals' drives cannot be identified: {unknown}"
    lag, offset, reaction = (float(each.value or 0.0) for each in drives.values())
    whole, offset = divmod(-float(np.median(sent)) + min(max(offset, 0.0), record.period), record.period)
    motion = _Motion(
        rate=np.interp(time, time - age, recording["precession_rate"]).tolist(),
        precession=np.interp(time, time - age, recording["precession"]).tolist(),
        late=int(whole),
    )
    drive = partial(SpeedLoopSteps, lag, offset, reaction, record.period)
    return Loop(
        begins=record.time[record.first],
        ends=record.time[record.last],
        controller=partial(_loop, vehicle, gains, record, at, drive, motion),
        needs=frozenset({"roll", "roll_rate"}),
        gives=frozenset({"precession_rate_setpoint", "precession_rate", "precession"}),
        channels=COMPARED,
    )


def _replayed(
    vehicle: MonocabFile, gains: RollDesign, record: Recorded, at: str, until: int
) -> tuple[RollController, list[float]]:
    """The controller before sample `until`, replayed on the recorded measurements, and its setpoints."""
    controller = RollController.from_design(gains, vehicle)
    controller.reset(record.values[SETPOINT][record.held])
    measured = [record.values[name] for name in MEASURED]
    rows = range(record.held + 1, until)
    return controller, [_step(controller, record, at, row, *(each[row] for each in measured)) for row in rows]


def _step(
    controller: RollController,
    record: Recorded,
    at: str,
    row: int,
    roll: float,
    roll_rate: float,
    rate: float,
    precession: float,
) -> float:
    value = record.values["excitation"][row]
    on_reference = is_reference(at)
    dt = record.time[row] - record.time[row - 1]
    reference, output = (value, 0.0) if on_reference else (0.0, value)
    return controller.step(roll, roll_rate, rate, precession, reference, dt, output)


def _loop(
    vehicle: MonocabFile,
    gains: RollDesign,
    record: Recorded,
    at: str,
    make_drive: partial[SpeedLoopSteps],
    motion: _Motion,
) -> Controller:
    """The controller and the drives in their state at the first excited sample."""
    controller, _ = _replayed(vehicle, gains, record, at, record.first)
    sent, rolled = record.values[SETPOINT], record.values["roll_rate"]
    begin = max(0, record.first - round(RUN_IN / record.period))
    drive = make_drive(setpoint=sent[begin])
    under_way = deque([sent[begin]] * motion.late)
    for row in range(begin, record.first):
        under_way.append(sent[row])
        drive.step(under_way.popleft(), rolled[row])
    rates, angles = motion.rate[: record.first + 1], motion.precession[: record.first + 1]
    row = record.first - 1

    def step(time: float, seen: Mapping[str, float]) -> Mapping[str, float]:
        nonlocal row
        row += 1
        rates[row] = seen.get("precession_rate", rates[row])
        angles[row] = seen.get("precession", angles[row])
        age = record.values["drive_age"][row] / record.period
        # If the drives are sampled after the IMU, their values are extrapolated linearly from this sample.
        whole = max(0, int(age))
        back, part = row - whole, age - whole
        setpoint = _step(
            controller,
            record,
            at,
            row,
            seen["roll"],
            seen["roll_rate"],
            rates[back] + part * (rates[back - 1] - rates[back]),
            angles[back] + part * (angles[back - 1] - angles[back]),
        )
        under_way.append(setpoint)
        following = drive.step(under_way.popleft(), seen["roll_rate"])
        # A model with drives of its own gives their rate; up to the next sample it is extrapolated linearly.
        rates.append(2.0 * rates[row] - rates[row - 1] if "precession_rate" in seen else following)
        angles.append(angles[row] + 0.5 * record.period * (rates[row] + rates[row + 1]))
        return {
            "precession_rate_setpoint": setpoint,
            "precession_rate": rates[row + 1],
            "precession": angles[row + 1],
        }

    return step
