"""How fast a force at a joint may swing and still show in an output: what an output does beyond that is its sensor's.

    |C (exp(i 2 pi f dt) - A)^-1 B| F > R^(1/2),    B = dt / inertia on the joint's rate

with F the joint's typical force and R the variance of the sensor's noise. An inertia turns a force of 30 Hz into a
thousandth of the angle that it makes of one of 1 Hz. So where innovations have more power at 30 Hz than at 80 Hz, no
force is missing: the error of the sensor has a colour, as an encoder's that counts while others wait.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from estimators.data.time_scale import time_scale
from estimators.fit.innovations import NoiseModel
from estimators.fit.problem import Problem
from models.expressions import names_in, number

Array = NDArray[np.float64]

SLOWEST = 8.0
"""Over the time scale (estimators.data.time_scale), Hz, below which an output is never its sensor's alone: 20 Hz of the
MONOCAB. A joint's typical force is known to its order of magnitude."""
SHARE = 0.1
"""Of a sensor's power above which the process noise of the model is not taken for the sensor's."""
FEWEST = 30
"""Lines of the spectrum above the reach that tell the sensor's noise."""


def reach(task: Problem, values: Array, sensor: Array) -> Array:
    """By output the frequency (ny,), Hz, above which no typical force shows beside its noise of std `sensor` (ny,);
    infinite where forces show up to half of the sampling rate, or where how a force acts is not known."""
    noise, names = NoiseModel.of(task), [state.name for state in task.model.states]
    system = noise.covariances(values, np.zeros(noise.size))
    transition, output, process = system[0], system[1], system[2]
    known = dict(zip(task.kernel.parameters, values.tolist(), strict=True))
    pushes = np.zeros((len(names), len(task.model.joints)))
    for place, joint in enumerate(task.model.joints):
        if joint.rate not in names or not names_in(joint.inertia) <= known.keys():
            return np.full(len(sensor), np.inf)
        inertia = number(joint.inertia, known, f"joint {joint.name}, inertia")
        pushes[names.index(joint.rate), place] = noise.spacing * joint.force_scale / inertia
    if not pushes.any() or not np.all(np.isfinite(pushes)):
        return np.full(len(sensor), np.inf)
    fastest = 0.5 / noise.spacing
    frequency = np.geomspace(min(SLOWEST / time_scale(task.model, task.segments), fastest), fastest, 60)
    turns = np.exp(2.0j * np.pi * frequency * noise.spacing)[:, None, None] * np.eye(len(names))
    through = output @ np.linalg.inv(turns - transition)
    forced = np.sum(np.abs(through @ pushes), axis=2) ** 2
    # White noise that a state is driven by may be any force, too.
    driven = np.einsum("fys,st,fyt->fy", through, process, np.conj(through)).real
    above = (forced > sensor**2) | (driven > SHARE * sensor**2)
    last = np.where(above.any(axis=0), len(frequency) - 1 - np.argmax(above[::-1], axis=0), 0)
    return np.where(last == len(frequency) - 1, np.inf, frequency[last])


def power_beyond(
    errors: Sequence[Array], spacing: float, limits: Array, expected: Callable[[Array], Array]
) -> tuple[Array, Array]:
    """Mean power (ny,) of `errors`, by stretch (n, ny), above `limits` (ny,), Hz, over what is `expected` there, and
    the number of lines (ny,) that tell it; 0 of both where there are too few.

    `expected` says of turns (m,), rad a row, the power densities (m, ny) that the sensors' noise alone would have.
    """
    total, lines = np.zeros(len(limits)), np.zeros(len(limits))
    for part in errors:
        window = np.hanning(len(part))[:, None]  # what a model lacks at 1 Hz must not leak to 50 Hz
        power = np.abs(np.fft.rfft(np.nan_to_num(part) * window, axis=0)) ** 2 / np.sum(window**2)
        frequency = np.fft.rfftfreq(len(part), spacing)
        turns = np.asarray(2.0 * np.pi * frequency * spacing, dtype=np.float64)
        beyond = frequency[:, None] > limits
        if beyond.any():
            least = expected(turns)
            total += np.sum(np.divide(power, least, out=np.zeros_like(power), where=beyond & (least > 0.0)), axis=0)
            lines += np.sum(beyond, axis=0)
    told = lines >= FEWEST
    return np.where(told, total / np.maximum(lines, 1.0), 0.0), np.where(told, lines, 0.0)
