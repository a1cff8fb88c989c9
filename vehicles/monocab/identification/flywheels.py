"""What the speeds of the flywheels say of them: are they where they should be, and how do they run down?

`angular_momentum` of a recording is theirs together (`vehicles.monocab.flywheels`), and not known where a speed is not.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import hypot

import numpy as np
from numpy.typing import NDArray

from upright.telemetry.recording import Recording
from upright.vehicles.commissioning import CommissioningError, Number
from upright.vehicles.monocab.file import MonocabFile

MOMENTUM = "angular_momentum"
END = 0.25
"""Share of a recording at its end over which the flywheels should keep their speed. Chosen."""
Array = NDArray[np.float64]


def measured(vehicle: MonocabFile, recordings: Sequence[Recording]) -> dict[str, tuple[float, float]]:
    """The mean angular momentum in `recordings`, N m s, and its standard deviation: the inertias', and how much it
    varied. Nothing if the file has no flywheels, or a recording does not know it."""
    values = [each[MOMENTUM][np.isfinite(each[MOMENTUM])] for each in recordings if MOMENTUM in each.values]
    if not vehicle.flywheel or len(values) < len(recordings) or not all(map(len, values)):
        return {}
    mean = float(np.mean(np.concatenate(values)))
    return {MOMENTUM: (mean, hypot(_std(vehicle, mean), float(np.std(np.concatenate(values)))))}


def spin_up(vehicle: MonocabFile, recordings: Sequence[Recording]) -> dict[str, Number]:
    """What the flywheels have reached in a recording in which they were brought to their speed.

    `angular_momentum` (N m s) and `momentum_off`, how far it is off the vehicle file's in standard deviations of both;
    `momentum_change` (% of the file's in a minute), the slope at the end. Raises CommissioningError if the flywheels do
    not report their speed.
    """
    _, (time, momentum) = _course(recordings[0])
    value = float(np.mean(momentum))
    slope = float(np.polyfit(time, momentum, 1)[0])
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
    for longer than that. `lost` is in % of what there was at the beginning. Raises CommissioningError if the flywheels
    do not report their speed.
    """
    first, (time, momentum) = _course(recordings[0])
    _, slope, value = (float(each) for each in np.polyfit(time - time[-1], momentum, 2))
    return {
        "lost": Number(value=100.0 * (1.0 - value / first) if first else None, unit="%"),
        "drag": Number(value=-slope, unit="N m"),
        "time_left": Number(value=-value / slope / 60.0 if slope < 0.0 else None, unit="min"),
    }


def _course(recording: Recording) -> tuple[float, tuple[Array, Array]]:
    """The first angular momentum that is known, N m s, and the END of its course: time (n,) s, angular momentum (n,).
    Raises CommissioningError if it is not known up to the end."""
    time, momentum = recording.time, recording[MOMENTUM]
    known = np.isfinite(momentum)
    last = time >= time[-1] - END * (time[-1] - time[0])
    if not known[last].all():
        raise CommissioningError(
            "a flywheel does not report its speed.",
            remedy="Switch its inverter on, and check can_id and start_byte of its [[flywheel]] section.",
        )
    return float(momentum[known][0]), (time[last], momentum[last])


def _std(vehicle: MonocabFile, momentum: float) -> float:
    """N m s, of the angular momentum from the speeds: that of the inertias, which are not known to be off together."""
    speed = momentum / sum(each.inertia.value for each in vehicle.flywheel)
    return abs(speed) * hypot(*(each.inertia.std for each in vehicle.flywheel))
