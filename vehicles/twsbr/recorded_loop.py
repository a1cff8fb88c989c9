"""What closed the loop while the balancing robot was recorded: its controller, the excitation, and its drives' age.

The controller is run over the recorded measurements first, from the row on in which the robot began to get up, once
with the excitation on the tilt reference and once on the voltage: where one of them gives the recorded voltages, this
is the controller that was there, and it is known as it was at any row. So the recording needs no metadata; one of
another robot or of other software is found out.

A model shows its wheels at the instant of the row, and the controller saw them older by `drive_age`: they are read back
that far. That an encoder of few counts tells a rate late, by as much as its last two edges are apart, is no part of it:
the tilt of a right model is off by up to 1.7 times the floor for that. The wheels come back to where they were, so that
a run may be as long as the record; with that switched off (`wheel_return_time` 0) their floor and error grow alike.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from math import degrees, radians

import numpy as np

from diagnosis.prediction.closed_loop import Controller, Limit
from diagnosis.prediction.closed_loop_error import Loop
from telemetry.recording import Recording
from vehicles.drives import drive_config
from vehicles.excitation import InjectionPoint
from vehicles.phases import Phase
from vehicles.twsbr.controller import TiltController
from vehicles.twsbr.file import TwsbrFile

TILT = ("tilt", "tilt_rate")
WHEELS = ("left_wheel_angle", "right_wheel_angle", "left_wheel_rate", "right_wheel_rate")
VOLTAGES = ("left_voltage", "right_voltage")
CHANNELS = (*TILT, *WHEELS, *VOLTAGES, "drive_age", "excitation", "phase")
"""Without which the loop is not known."""
COMPARED = ("tilt", "left_wheel_angle", "right_wheel_angle")
SAME = 0.01
"""Share of the voltages' RMS by which the controller may differ from the recorded ones: some rows may be lost."""


@dataclass(frozen=True, slots=True)
class _Recorded:
    """A recording as lists, for loops: the controller ran from the row after `rise` on, excited from `first` on."""

    values: Mapping[str, list[float]]
    time: list[float]
    period: float
    rise: int
    first: int
    last: int

    def elapsed(self, row: int) -> float:
        """s since the row before, as the control loop counts them: a gap does not throw its controller."""
        return min(max(self.time[row] - self.time[row - 1], 0.5 * self.period), 4.0 * self.period)


def recorded_loop(vehicle: TwsbrFile, recording: Recording) -> Loop | str:
    """The loop of `recording` from the first row of its excitation on, or why it is not known, in words."""
    lacking = [name for name in CHANNELS if name not in recording.values]
    if lacking:
        return f"the recording has no channel {', '.join(lacking)}: what drove the controller is not known"
    phase, excitation = recording["phase"], recording["excitation"]
    if not np.isfinite(excitation).any() or not np.isfinite(phase).any():
        return "the recording does not hold the excitation, as one from a raw CAN log: take the .arrow beside it"
    held = np.flatnonzero((phase >= Phase.RISE) & (phase <= Phase.FADE))
    excited = np.flatnonzero((phase >= Phase.EXCITE) & (phase <= Phase.FADE) & np.isfinite(excitation))
    if not len(excited) or not np.any(excitation[excited]):
        return "nothing excites the robot while its controller holds it up"
    if held[0] == 0 or phase[held[0]] != Phase.RISE:
        return "the recording begins later than the controller: its state is not known"
    if not all(np.isfinite(recording[name][held]).all() for name in CHANNELS):
        return "the recording has unknown values while the controller holds the robot up"
    time = recording.time
    told = _Recorded(
        values={name: recording[name].tolist() for name in CHANNELS},
        time=time.tolist(),
        period=vehicle.period,
        rise=int(held[0]),
        first=int(excited[0]),
        last=int(excited[-1]),
    )
    at = _injection(vehicle, told)
    if at is None:
        return f"the controller of {vehicle.vehicle.id}'s vehicle file does not give the recorded voltages"
    return Loop(
        begins=told.time[told.first],
        ends=told.time[told.last],
        controller=partial(_loop, vehicle, told, at),
        needs=frozenset((*TILT, *WHEELS)),
        gives=frozenset(VOLTAGES),
        channels=COMPARED,
        limits=(
            Limit("tilt", radians(vehicle.limits.upright_deg), "deg", "at which the robot has fallen", degrees(1.0)),
        ),
    )


def _injection(vehicle: TwsbrFile, told: _Recorded) -> InjectionPoint | None:
    """Where the excitation enters, so that the controller gives the recorded voltages; None where it does not."""
    sent = np.array([told.values[name] for name in VOLTAGES])
    for at in (InjectionPoint.CONTROLLER_OUTPUT, InjectionPoint.TILT_REFERENCE):
        given = np.array(_replayed(vehicle, told, at, told.last)[1])
        errors = given - sent[:, told.rise + 1 : told.last]
        if np.sqrt(np.mean(errors**2)) < SAME * np.sqrt(np.mean(sent[:, told.rise : told.last] ** 2)):
            return at
    return None


def _replayed(
    vehicle: TwsbrFile, told: _Recorded, at: InjectionPoint, until: int
) -> tuple[TiltController, list[float]]:
    """The controller before row `until`, run over the recorded measurements, and the voltages it gave."""
    controller = TiltController.of(vehicle)
    measured = [told.values[name] for name in (*TILT, *WHEELS)]
    rows = range(told.rise + 1, until)
    sent = drive_config(vehicle, vehicle.drive[0]).resolved
    return controller, [
        sent(_step(vehicle, controller, told, at, row, *(each[row] for each in measured))) for row in rows
    ]


def _step(
    vehicle: TwsbrFile,
    controller: TiltController,
    told: _Recorded,
    at: InjectionPoint,
    row: int,
    tilt: float,
    tilt_rate: float,
    left_angle: float,
    right_angle: float,
    left_rate: float,
    right_rate: float,
) -> float:
    value = told.values["excitation"][row]
    on_reference = at is InjectionPoint.TILT_REFERENCE
    radius = vehicle.parameters.wheel_radius.value
    origin = told.values["left_wheel_angle"][told.rise] + told.values["right_wheel_angle"][told.rise]
    return controller.step(
        tilt,
        tilt_rate,
        radius * (0.5 * (left_angle + right_angle - origin) + tilt),
        radius * (0.5 * (left_rate + right_rate) + tilt_rate),
        value if on_reference else 0.0,
        told.elapsed(row),
        0.0 if on_reference else value,
    )


def _loop(vehicle: TwsbrFile, told: _Recorded, at: InjectionPoint) -> Controller:
    """The controller as it was at the first excited row."""
    controller, _ = _replayed(vehicle, told, at, told.first)
    # The wheels at the instants of the rows: as recorded, until the model shows them.
    time, age = np.array(told.time), np.array(told.values["drive_age"])
    wheels = {name: np.interp(time[: told.first + 1], time - age, told.values[name]).tolist() for name in WHEELS}
    row = told.first - 1
    sent = drive_config(vehicle, vehicle.drive[0])

    def step(time: float, seen: Mapping[str, float]) -> Mapping[str, float]:
        nonlocal row
        row += 1
        age = told.values["drive_age"][row] / told.period
        # Drives that are sampled after the IMU went on from this row as before.
        whole = max(0, int(age))
        back, part = row - whole, age - whole
        shown = []
        for name, column in wheels.items():
            if row < len(column):
                column[row] = seen[name]
            else:
                column.append(seen[name])
            shown.append(column[back] + part * (column[back - 1] - column[back]))
        voltage = _step(vehicle, controller, told, at, row, seen["tilt"], seen["tilt_rate"], *shown)
        return dict.fromkeys(VOLTAGES, sent.resolved(voltage))

    return step
