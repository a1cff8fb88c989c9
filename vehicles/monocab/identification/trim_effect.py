"""The weight of the trim mass against the angular momentum of the flywheels.

While the vehicle balances, the trim mass moves as a sine. At its frequency the balance of torques reads

    (inertia w^2 + gravity_stiffness) Roll + angular_momentum PrecessionRate
        + effect trim_mass (g + trim_height w^2) Trim = 0

with the capital letters for complex amplitudes. `effect` is 1 if the mass weighs on the vehicle what the file says. It
is 0 if the mass sticks while its motor turns, negative if it runs the wrong way, and otherwise tells that angular
momentum, gear ratio, lead or mass are wrong.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import pi, sqrt

import numpy as np
from numpy.typing import NDArray

from estimators.methods.prediction_error import prediction_error
from models.gravity import GRAVITY
from telemetry.recording import Recording
from vehicles.commissioning import Number
from vehicles.monocab.file import MonocabFile
from vehicles.monocab.model import MONOCAB_ROLL
from vehicles.phases import Phase

NEIGHBOURS = (-5, -4, -3, 3, 4, 5)
"""Distance, in 1/duration, of the lines from which the disturbance is estimated: beyond the window's main lobe."""

Array = NDArray[np.float64]


def trim_effect(vehicle: MonocabFile, recordings: Sequence[Recording]) -> dict[str, Number]:
    """`trim_effect` with its standard deviation from the disturbance beside the frequency of the sine and from the
    parameters. The first of `recordings` is that of the sine, at least one other has to identify inertia and stiffness.
    """
    values, deviations = dict(vehicle.parameters.values), dict(vehicle.parameters.deviations)
    if len(recordings) > 1:
        model = MONOCAB_ROLL.add("static_torque")
        found = prediction_error(model, list(recordings[1:]), support=vehicle.support)
        for name in ("inertia", "gravity_stiffness"):
            each = found.parameters[name]
            if each.value is not None and each.std is not None:
                values[name], deviations[name] = each.value, each.std
    recording = recordings[0]
    rows = recording["phase"] == Phase.EXCITE
    time = recording.time[rows]
    late = time - recording["drive_age"][rows]
    roll, rate, trim = (recording[name][rows] for name in ("roll", "precession_rate", "trim_position"))
    frequency = _frequency(time, recording["excitation"][rows])

    def sums(f: float) -> tuple[complex, complex, complex]:
        w = (2.0 * pi * f) ** 2
        turned = (values["inertia"] * w + values["gravity_stiffness"]) * _amplitude(time, roll, f)
        turned += values["angular_momentum"] * _amplitude(late, rate, f)
        weight = values["trim_mass"] * (GRAVITY + values["trim_height"] * w) * _amplitude(late, trim, f)
        return turned, weight, _amplitude(time, roll, f)

    turned, weight, rolled = sums(frequency)
    if abs(weight) == 0.0:
        return {"trim_effect": Number(value=None)}
    effect = (-turned / weight).real
    span = float(time[-1] - time[0])
    beside = [sum_ + effect * other for sum_, other, _ in (sums(frequency + each / span) for each in NEIGHBOURS)]
    disturbed = sqrt(float(np.mean(np.abs(beside) ** 2)) / 2.0) / abs(weight)
    w = (2.0 * pi * frequency) ** 2
    known = (
        abs(rolled) * deviations["gravity_stiffness"] / abs(weight),
        abs(rolled) * w * deviations["inertia"] / abs(weight),
        deviations["angular_momentum"] / values["angular_momentum"],
        deviations["trim_mass"] / values["trim_mass"],
    )
    std = sqrt(disturbed**2 + sum(each**2 for each in known))
    return {"trim_effect": Number(value=effect, std=std)}


def _frequency(time: Array, excitation: Array) -> float:
    """Hz of the sine, from its zero crossings."""
    signs = np.signbit(excitation)
    crossings = time[1:][signs[1:] != signs[:-1]]
    return 0.5 * (len(crossings) - 1) / float(crossings[-1] - crossings[0])


def _amplitude(time: Array, values: Array, frequency: float) -> complex:
    """Complex amplitude at `frequency` (Hz), with a Hann window over the whole record."""
    span = time[-1] - time[0]
    window = 0.5 - 0.5 * np.cos(2.0 * pi * (time - time[0]) / span)
    turned = np.exp(-2j * pi * frequency * time)
    return complex(2.0 * np.sum(window * (values - np.mean(values)) * turned) / np.sum(window))
