"""What closed the loop while the cube was recorded: its controller, the excitation, and its drive's age.

The controller is run over the recorded measurements first (vehicles.recorded), from the row on in which the cube began
to get up. A model shows its wheel at the instant of the row, and the controller saw it older by `drive_age`: it is read
back that far.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from math import degrees, radians

import numpy as np

from diagnosis.prediction.closed_loop import Controller, Limit
from diagnosis.prediction.closed_loop_error import Loop
from models.control_design import LqiGains
from telemetry.errors import UprightError
from telemetry.recording import Recording
from vehicles.cube.controller import WheelController, design
from vehicles.cube.file import CubeFile
from vehicles.drives import drive_config
from vehicles.phases import Phase
from vehicles.recorded import Recorded, entered_at, recorded
from vehicles.sections import CONTROLLER_OUTPUT

MEASURED = ("tilt", "tilt_rate", "wheel_rate")
COMPARED = ("tilt", "wheel_rate")


def recorded_loop(vehicle: CubeFile, recording: Recording) -> Loop | str:
    """The loop of `recording` from the first row of its excitation on, or why it is not known, in words."""
    told = recorded(recording, (*MEASURED, "torque"), since=Phase.RISE, period=vehicle.period)
    if isinstance(told, str):
        return told
    try:
        gains = design(vehicle).gains
    except UprightError as error:
        return f"the loop cannot be made: {error}"
    at = entered_at((CONTROLLER_OUTPUT,), lambda at: [_replayed(vehicle, gains, told, told.last)[1]], told, ("torque",))
    if at is None:
        return f"the controller of {vehicle.vehicle.id}'s vehicle file does not give the recorded torques"
    return Loop(
        begins=told.time[told.first],
        ends=told.time[told.last],
        controller=partial(_loop, vehicle, gains, told),
        needs=frozenset(MEASURED),
        gives=frozenset({"torque"}),
        channels=COMPARED,
        limits=(
            Limit("tilt", radians(vehicle.limits.upright_deg), "deg", "at which the cube has fallen", degrees(1.0)),
        ),
    )


def _replayed(vehicle: CubeFile, gains: LqiGains, told: Recorded, until: int) -> tuple[WheelController, list[float]]:
    """The controller before row `until`, run over the recorded measurements, and the torques it gave."""
    controller = WheelController(gains, vehicle.limits.torque)
    sent = drive_config(vehicle, vehicle.drive[0]).resolved
    columns = [told.values[name] for name in (*MEASURED, "excitation")]
    given = []
    # The row in which it began to get up is its first step already.
    for row in range(told.held, until):
        tilt, tilt_rate, wheel_rate, excitation = (each[row] for each in columns)
        given.append(sent(controller.step(tilt, tilt_rate, wheel_rate, told.elapsed(row), excitation)))
    return controller, given[1:]


def _loop(vehicle: CubeFile, gains: LqiGains, told: Recorded) -> Controller:
    """The controller as it was at the first excited row."""
    controller, _ = _replayed(vehicle, gains, told, told.first)
    # The wheel at the instants of the rows: as recorded, until the model shows it.
    time, age = np.array(told.time), np.array(told.values["drive_age"])
    wheel = np.interp(time[: told.first + 1], time - age, told.values["wheel_rate"]).tolist()
    row = told.first - 1
    sent = drive_config(vehicle, vehicle.drive[0])

    def step(time: float, seen: Mapping[str, float]) -> Mapping[str, float]:
        nonlocal row
        row += 1
        if row < len(wheel):
            wheel[row] = seen["wheel_rate"]
        else:
            wheel.append(seen["wheel_rate"])
        age = told.values["drive_age"][row] / told.period
        # A drive that is sampled after the IMU went on from this row as before.
        whole = max(0, int(age))
        back, part = row - whole, age - whole
        rate = wheel[back] + part * (wheel[back - 1] - wheel[back])
        excitation = told.values["excitation"][row]
        torque = controller.step(seen["tilt"], seen["tilt_rate"], rate, told.elapsed(row), excitation)
        return {"torque": sent.resolved(torque)}

    return step
