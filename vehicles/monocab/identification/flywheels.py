"""What the speeds of the flywheels say of them: are they where they should be, and how do they run down?

`angular_momentum` of a recording is theirs together (`vehicles.monocab.flywheels`). Where the vehicle file does not say
how their speed is read, a recording says nothing of it.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import hypot

import numpy as np
from numpy.typing import NDArray

from upright.telemetry.recording import Recording
from upright.vehicles.commissioning import Number
from upright.vehicles.monocab.file import MonocabFile

MOMENTUM = "angular_momentum"
END = 0.25
"""Share of a recording at its end over which the flywheels should keep their speed."""
BEGIN = 1.0
"""s at the beginning of a recording that are left out: the first reports may still be missing."""
Array = NDArray[np.float64]


def measured(vehicle: MonocabFile, recordings: Sequence[Recording]) -> dict[str, tuple[float, float]]:
    """The angular momentum in `recordings`, N m s, and its standard deviation: the inertias', and how much it varied.
    Nothing if the speeds are not measured."""
    if not vehicle.flywheel or not all(MOMENTUM in each.values for each in recordings):
        return {}
    values = np.concatenate([_known(each)[1] for each in recordings])
    if not values.size:
        return {}
    mean = float(np.mean(values))
    return {MOMENTUM: (mean, hypot(_std(vehicle, mean), float(np.std(values))))}


def spin_up(vehicle: MonocabFile, recordings: Sequence[Recording]) -> dict[str, Number]:
    """The angular momentum at the end of a recording in which the flywheels were brought to their speed."""
    time, momentum = _known(recordings[0])
    last = time >= time[-1] - END * (time[-1] - time[0])
    value = float(np.mean(momentum[last]))
    slope = float(np.polyfit(time[last], momentum[last], 1)[0])
    entry, std = vehicle.parameters.angular_momentum, _std(vehicle, value)
    return {
        MOMENTUM: Number(value=value, std=std, unit="N m s"),
        "momentum_off": Number(value=(value - entry.value) / hypot(entry.std, std)),
        "momentum_change": Number(value=100.0 * 60.0 * slope / entry.value, unit="%"),
    }


def run_down(vehicle: MonocabFile, recordings: Sequence[Recording]) -> dict[str, Number]:
    """What is lost in a recording in which the flywheels were switched off, by which torque, and how long it takes.

    `drag` (N m, of all of them) is what slows them down at the end, the slope there of a parabola over the last
    quarter; `time_left` (min) is how long that torque needs to stop them. Drag falls with the speed, so that they turn
    for longer than that.
    """
    time, momentum = _known(recordings[0])
    last = time >= time[-1] - END * (time[-1] - time[0])
    _, slope, value = (float(each) for each in np.polyfit(time[last] - time[-1], momentum[last], 2))
    return {
        "lost": Number(value=100.0 * (1.0 - value / float(momentum[0])) if momentum[0] else None, unit="%"),
        "drag": Number(value=-slope, unit="N m"),
        "time_left": Number(value=-value / slope / 60.0 if slope < 0.0 else None, unit="min"),
    }


def _known(recording: Recording) -> tuple[Array, Array]:
    """Time (n,) s and angular momentum (n,) N m s of the samples in which it is known."""
    time, momentum = recording.time, recording[MOMENTUM]
    kept = np.isfinite(momentum) & (time >= time[0] + BEGIN)
    return time[kept], momentum[kept]


def _std(vehicle: MonocabFile, momentum: float) -> float:
    """N m s, of the angular momentum from the speeds: that of the inertias, which are not known to be off together."""
    speed = momentum / sum(each.inertia.value for each in vehicle.flywheel)
    return abs(speed) * hypot(*(each.inertia.std for each in vehicle.flywheel))
