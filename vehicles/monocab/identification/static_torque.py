"""The static torque on a vehicle that balances, from its balance of momentum alone.

Over a time in which it stays up, the gimbals have to supply what gravity and a static torque take:

    static_torque duration = the change of inertia roll_rate - angular_momentum precession, from begin to end,
                             less the integral of gravity_stiffness roll + trim_mass g trim_position

No fit is needed, so that neither friction nor a disturbance of any kind prevents the answer: they are in its deviation,
which follows from the scatter of the parts of the record.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import sqrt

import numpy as np

from upright.models.gravity import GRAVITY
from upright.telemetry.recording import Recording
from upright.vehicles.commissioning import Number
from upright.vehicles.experiment.phases import Phase
from upright.vehicles.experiment.recorded import designed_for
from upright.vehicles.monocab.file import MonocabFile

PARTS = 8
"""Parts of the record, each several times longer than the correlation of a disturbance."""


def static_torque(vehicle: MonocabFile, recordings: Sequence[Recording]) -> dict[str, Number]:
    """`static_torque`, N m, and `trim_shift`, mm by which the trim mass has to move to balance it, from the first of
    `recordings`, with the parameters that its controller was designed for."""
    recording = recordings[0]
    values = {**vehicle.parameters.values, **designed_for(recording)}
    excited = np.flatnonzero(recording["phase"] == Phase.EXCITE)
    time, roll = recording.time, recording["roll"]
    weight = values["gravity_stiffness"] * roll + values["trim_mass"] * GRAVITY * recording["trim_position"]
    momentum = values["inertia"] * recording["roll_rate"] - values["angular_momentum"] * recording["precession"]
    torques = []
    for rows in np.array_split(excited, PARTS):
        part = slice(rows[0], rows[-1] + 1)
        span = time[rows[-1]] - time[rows[0]]
        change = momentum[rows[-1]] - momentum[rows[0]]
        torques.append((change - float(np.trapezoid(weight[part], time[part]))) / span)
    torque, scatter = float(np.mean(torques)), float(np.std(torques, ddof=1)) / sqrt(PARTS)
    known = abs(float(np.mean(roll[excited]))) * vehicle.parameters.deviations["gravity_stiffness"]
    std = sqrt(scatter**2 + known**2)
    per_torque = 1e3 / (values["trim_mass"] * GRAVITY)
    return {
        "static_torque": Number(value=torque, std=std, unit="N m"),
        "trim_shift": Number(value=-per_torque * torque, std=per_torque * std, unit="mm"),
    }
