"""What closed the loop while the cube was recorded: its controller, the excitation, and its drive's age.

The controller is first replayed on the recorded measurements (vehicles.experiment.recorded), from the sample on in
which the cube began to get up. A model gives its wheel's rate at the sampling instant, but the controller saw a value
older by `drive_age`: the model's value is taken from that much earlier.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from math import degrees, radians

import numpy as np

from upright.diagnosis.prediction.closed_loop import Controller, Limit
from upright.diagnosis.prediction.closed_loop_error import Loop
from upright.models.control_design.lqi import LqiGains
from upright.telemetry.errors import UprightError
from upright.telemetry.recording import Recording
from upright.vehicles.cube.controller import WheelController, design
from upright.vehicles.cube.file import CubeFile
from upright.vehicles.drives import drive_config
from upright.vehicles.experiment.phases import Phase
from upright.vehicles.experiment.recorded import Recorded, entered_at, recorded
from upright.vehicles.sections import CONTROLLER_OUTPUT

MEASURED = ("tilt", "tilt_rate", "wheel_rate")
COMPARED = ("tilt", "wheel_rate")


def recorded_loop(vehicle: CubeFile, recording: Recording) -> Loop | str:
    """The loop of `recording` from the first sample of its excitation on, or why it is not known, in words."""
    record = recorded(
        recording, (*MEASURED, "torque"), since=Phase.RISE, period=vehicle.period, longest=vehicle.longest_silence
    )
    if isinstance(record, str):
        return record
    try:
        gains = design(vehicle).gains
    except UprightError as error:
        return f"the loop cannot be reconstructed: {error}"
    at = entered_at(
        (CONTROLLER_OUTPUT,), lambda at: [_replayed(vehicle, gains, record, record.last)[1]], record, ("torque",)
    )
    if at is None:
        return f"the controller of {vehicle.vehicle.id}'s vehicle file does not give the recorded torques"
    return Loop(
        begins=record.time[record.first],
        ends=record.time[record.last],
        controller=lambda model: partial(_loop, vehicle, gains, record),
        needs=frozenset(MEASURED),
        gives=frozenset({"torque"}),
        channels=COMPARED,
        limits=(
            Limit("tilt", radians(vehicle.limits.upright_deg), "deg", "at which the cube has fallen", degrees(1.0)),
        ),
    )


def _replayed(vehicle: CubeFile, gains: LqiGains, record: Recorded, until: int) -> tuple[WheelController, list[float]]:
    """The controller before sample `until`, replayed on the recorded measurements, and its torques."""
    controller = WheelController(gains, vehicle.limits.torque)
    sent = drive_config(vehicle, vehicle.drive[0]).resolved
    columns = [record.values[name] for name in (*MEASURED, "excitation")]
    given = []
    # The sample in which it began to get up is already its first step.
    for row in range(record.held, until):
        tilt, tilt_rate, wheel_rate, excitation = (each[row] for each in columns)
        given.append(sent(controller.step(tilt, tilt_rate, wheel_rate, record.elapsed(row), excitation)))
    return controller, given[1:]


def _loop(vehicle: CubeFile, gains: LqiGains, record: Recorded, begins: float) -> Controller:
    """The controller in its state at the sample at `begins` s."""
    first = record.row(begins)
    controller, _ = _replayed(vehicle, gains, record, first)
    # The wheel at the sampling instants: as recorded, until the model gives it.
    time, age = np.array(record.time), np.array(record.values["drive_age"])
    wheel = np.interp(time[: first + 1], time - age, record.values["wheel_rate"]).tolist()
    row = first - 1
    sent = drive_config(vehicle, vehicle.drive[0])

    def step(time: float, seen: Mapping[str, float]) -> Mapping[str, float]:
        nonlocal row
        row += 1
        if row < len(wheel):
            wheel[row] = seen["wheel_rate"]
        else:
            wheel.append(seen["wheel_rate"])
        age = record.values["drive_age"][row] / record.period
        # If the drive is sampled after the IMU, its value is extrapolated linearly from this sample.
        whole = max(0, int(age))
        back, part = row - whole, age - whole
        rate = wheel[back] + part * (wheel[back - 1] - wheel[back])
        excitation = record.values["excitation"][row]
        torque = controller.step(seen["tilt"], seen["tilt_rate"], rate, record.elapsed(row), excitation)
        return {"torque": sent.resolved(torque)}

    return step
