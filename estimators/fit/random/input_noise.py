"""White noise of a measured input, estimated from its samples alone, without a model of the vehicle.

    u(k) = level(k) + v(k),    level(k + 1) = level(k) + w(k)        v, w white

is a random walk that is measured with noise. The innovations of the filter level += gain (u - level) are white, and its
gain is estimated by maximum likelihood. Without noise it is 1. Source: Harvey, "Forecasting, structural time series
models and the Kalman filter" (1989), section 4.1.2 (local level).
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar

from upright.estimators.fit.problem import Problem
from upright.models.random.input_noise import InputNoise

Array = NDArray[np.float64]

GAINS = 24
"""Number of gains that are tried, from that of a filter with a memory as long as the record to 1, that without noise.

The maximum of the likelihood is searched for around the best of them, so their number is not critical."""


def input_noise(task: Problem, name: str) -> InputNoise | None:
    """White noise of the input `name` in the data of `task`; None if they show none."""
    place = task.kernel.inputs.index(name)
    parts = [np.ascontiguousarray(segment.row_inputs[:, place]) for segment in task.segments]
    power = float(np.var(np.concatenate(parts)))
    rows = max(map(len, parts))
    if power == 0.0 or rows < 2:
        return None

    def cost(logarithm: float) -> float:
        return _cost(parts, math.exp(logarithm))

    tried = np.linspace(-math.log(rows), 0.0, GAINS)
    best = int(np.argmin([cost(each) for each in tried.tolist()]))
    if best == GAINS - 1:
        return None
    around = (float(tried[max(best - 1, 0)]), float(tried[best + 1]))
    found = minimize_scalar(cost, bounds=around, method="bounded")
    gain, count = math.exp(float(found.x)), sum(map(len, parts))
    if cost(0.0) - cost(math.log(gain)) < 0.5 * math.log(count):
        return None
    white = (1.0 - gain) * float(np.mean(np.concatenate(_all_innovations(parts, gain)) ** 2))
    return InputNoise(
        name=name,
        std=math.sqrt(white),
        time=-_spacing(task) / math.log1p(-gain),
        level=float(np.mean(np.concatenate(parts))),
        # A constant level is known as well as a mean.
        spread=math.sqrt(gain * white + max(power - white, 0.0)),
    )


def rough(task: Problem, noise: InputNoise) -> list[Array]:
    """Innovations of the filter of `noise` on its input, by segment (n,): mostly the noise."""
    place = task.kernel.inputs.index(noise.name)
    gain = -math.expm1(-_spacing(task) / noise.time)
    return [_innovations(segment.row_inputs[:, place], gain, noise.level) for segment in task.segments]


def _spacing(task: Problem) -> float:
    return float(np.median(np.diff(task.segments[0].time)))


def _cost(parts: Sequence[Array], gain: float) -> float:
    """Negative log-likelihood of the innovations at `gain` and at their likeliest variance, but for a constant."""
    error = np.concatenate(_all_innovations(parts, gain))
    return 0.5 * len(error) * math.log(max(float(np.mean(error**2)), 1e-300))


def _all_innovations(parts: Sequence[Array], gain: float) -> list[Array]:
    """By segment (n,); the level begins at the mean over the memory of the filter."""
    return [_innovations(part, gain, float(np.mean(part[: max(1, round(1.0 / gain))]))) for part in parts]


def _innovations(readings: Array, gain: float, level: float) -> Array:
    """Innovations (n,) if the level begins at `level`."""
    from scipy.signal import lfilter  # half a second of imports, which not every command needs

    # e(k) = u(k) - level(k), level(k + 1) = level(k) + gain e(k): e = (1 - z^-1) / (1 - (1 - gain) z^-1) u.
    return np.asarray(lfilter([1.0, -1.0], [1.0, -(1.0 - gain)], readings - level))
