"""Up to which frequency a force at a joint shows in an output: beyond it, an output only shows its sensor's error.

    |C (exp(i 2 pi f dt) - A)^-1 B| F > R^(1/2),    B = dt / inertia on the joint's rate

with F the joint's typical force and R the variance of the sensor's noise. With an inertia, a force of 30 Hz makes a
thousandth of the angle that a force of 1 Hz makes. So if innovations have more power at 30 Hz than at 80 Hz, no force
is missing: the error of the sensor is coloured, like that of an encoder that counts while others wait.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from upright.estimators.data.time_scale import time_scale
from upright.estimators.fit.innovations import NoiseModel
from upright.estimators.fit.problem import Problem
from upright.models.text.expressions import names_in, number

Array = NDArray[np.float64]

SLOWEST = 8.0
"""Over the time scale (estimators.data.time_scale), Hz, below which an output never shows its sensor's error alone: 20
Hz of the MONOCAB. A joint's typical force is known only to its order of magnitude."""
SHARE = 0.1
"""Share of a sensor's power above which the model's process noise is not attributed to the sensor."""
FEWEST = 30
"""Spectral lines above the reach that are needed to estimate the sensor's noise."""


def reach(task: Problem, values: Array, sensor: Array) -> Array:
    """By output the frequency (ny,), Hz, above which no typical force shows beside its noise of std `sensor` (ny,);
    infinite if forces show up to half of the sampling rate, or if it is not known how a force acts."""
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
    # White noise that drives a state may be any force, too.
    driven = np.einsum("fys,st,fyt->fy", through, process, np.conj(through)).real
    above = (forced > sensor**2) | (driven > SHARE * sensor**2)
    last = np.where(above.any(axis=0), len(frequency) - 1 - np.argmax(above[::-1], axis=0), 0)
    return np.where(last == len(frequency) - 1, np.inf, frequency[last])


def power_beyond(
    errors: Sequence[Array], spacing: float, limits: Array, expected: Callable[[Array], Array]
) -> tuple[Array, Array]:
    """Mean power (ny,) of `errors`, by segment (n, ny), above `limits` (ny,), Hz, relative to what is `expected` there,
    and the number of spectral lines (ny,) it is estimated from; both are 0 if there are too few lines.

    `expected` gives, for turns (m,) in rad per sample, the power densities (m, ny) that the sensors' noise alone would
    have.
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
    enough = lines >= FEWEST
    return np.where(enough, total / np.maximum(lines, 1.0), 0.0), np.where(enough, lines, 0.0)
