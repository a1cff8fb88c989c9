"""What closed the loop while the balancing robot was recorded: its controller, the excitation, and its drives' age.

The controller is first replayed on the recorded measurements (vehicles.experiment.recorded), from the sample on in
which the robot began to get up, once with the excitation on the voltage and once on the tilt reference.

A model gives the wheels at the sampling instant, but the controller saw values older by `drive_age`: the model's values
are taken from that much earlier. The additional lag of the rate of an encoder of few counts, by the time between its
last two edges, is not included: for that the tilt of a right model is off by up to 1.7 times the floor. The wheels come
back to where they were, so that a run may be as long as the record; with that switched off (`wheel_return_time` 0)
their floor and error grow at the same rate.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from math import degrees, radians

import numpy as np

from upright.diagnosis.prediction.closed_loop import Controller, Limit
from upright.diagnosis.prediction.closed_loop_error import Loop
from upright.telemetry.recording import Recording
from upright.vehicles.drives import drive_config
from upright.vehicles.experiment.phases import Phase
from upright.vehicles.experiment.recorded import Recorded, entered_at, recorded
from upright.vehicles.sections import CONTROLLER_OUTPUT, is_reference
from upright.vehicles.twsbr.controller import TiltController
from upright.vehicles.twsbr.file import TwsbrFile

TILT = ("tilt", "tilt_rate")
WHEELS = ("left_wheel_angle", "right_wheel_angle", "left_wheel_rate", "right_wheel_rate")
VOLTAGES = ("left_voltage", "right_voltage")
COMPARED = ("tilt", "left_wheel_angle", "right_wheel_angle")


def recorded_loop(vehicle: TwsbrFile, recording: Recording) -> Loop | str:
    """The loop of `recording` from the first sample of its excitation on, or why it is not known, in words."""
    record = recorded(
        recording, (*TILT, *WHEELS, *VOLTAGES), since=Phase.RISE, period=vehicle.period, longest=vehicle.longest_silence
    )
    if isinstance(record, str):
        return record
    points = (CONTROLLER_OUTPUT, "tilt_reference")
    at = entered_at(points, lambda at: [_replayed(vehicle, record, at, record.last)[1]], record, VOLTAGES)
    if at is None:
        return f"the controller of {vehicle.vehicle.id}'s vehicle file does not give the recorded voltages"
    return Loop(
        begins=record.time[record.first],
        ends=record.time[record.last],
        controller=lambda model: partial(_loop, vehicle, record, at),
        needs=frozenset((*TILT, *WHEELS)),
        gives=frozenset(VOLTAGES),
        channels=COMPARED,
        limits=(
            Limit("tilt", radians(vehicle.limits.upright_deg), "deg", "at which the robot has fallen", degrees(1.0)),
        ),
    )


def _replayed(vehicle: TwsbrFile, record: Recorded, at: str, until: int) -> tuple[TiltController, list[float]]:
    """The controller before sample `until`, replayed on the recorded measurements, and its voltages."""
    controller = TiltController.of(vehicle)
    measured = [record.values[name] for name in (*TILT, *WHEELS)]
    rows = range(record.held + 1, until)
    sent = drive_config(vehicle, vehicle.drive[0]).resolved
    return controller, [
        sent(_step(vehicle, controller, record, at, row, *(each[row] for each in measured))) for row in rows
    ]


def _step(
    vehicle: TwsbrFile,
    controller: TiltController,
    record: Recorded,
    at: str,
    row: int,
    tilt: float,
    tilt_rate: float,
    left_angle: float,
    right_angle: float,
    left_rate: float,
    right_rate: float,
) -> float:
    value = record.values["excitation"][row]
    on_reference = is_reference(at)
    radius = vehicle.parameters.wheel_radius.value
    origin = record.values["left_wheel_angle"][record.held] + record.values["right_wheel_angle"][record.held]
    return controller.step(
        tilt,
        tilt_rate,
        radius * (0.5 * (left_angle + right_angle - origin) + tilt),
        radius * (0.5 * (left_rate + right_rate) + tilt_rate),
        value if on_reference else 0.0,
        record.elapsed(row),
        0.0 if on_reference else value,
    )


def _loop(vehicle: TwsbrFile, record: Recorded, at: str, begins: float) -> Controller:
    """The controller in its state at the sample at `begins` s."""
    first = record.row(begins)
    controller, _ = _replayed(vehicle, record, at, first)
    # The wheels at the sampling instants: as recorded, until the model gives them.
    time, age = np.array(record.time), np.array(record.values["drive_age"])
    wheels = {name: np.interp(time[: first + 1], time - age, record.values[name]).tolist() for name in WHEELS}
    row = first - 1
    sent = drive_config(vehicle, vehicle.drive[0])

    def step(time: float, seen: Mapping[str, float]) -> Mapping[str, float]:
        nonlocal row
        row += 1
        age = record.values["drive_age"][row] / record.period
        # If the drives are sampled after the IMU, their values are extrapolated linearly from this sample.
        whole = max(0, int(age))
        back, part = row - whole, age - whole
        shown = []
        for name, column in wheels.items():
            if row < len(column):
                column[row] = seen[name]
            else:
                column.append(seen[name])
            shown.append(column[back] + part * (column[back - 1] - column[back]))
        voltage = _step(vehicle, controller, record, at, row, seen["tilt"], seen["tilt_rate"], *shown)
        return dict.fromkeys(VOLTAGES, sent.resolved(voltage))

    return step
