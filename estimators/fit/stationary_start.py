"""Initial state of a segment: a disturbance begins stationary, and is integrated out of the likelihood.

    p(y) = integral of p(y | x0) p(x0) dx0,    -ln p(y) = -ln p(y | x0*) p(x0*) + 1/2 ln det(D + P^-1) + a constant

with x0* the likeliest initial state, P its prior covariance and D the information of the record on it. P depends on the
RMS of the disturbance, which is estimated. If the likelihood were maximised over x0 as well, it would grow without
bound as that RMS goes to zero. Laplace's method, exact for a linear model; D is that of a long record
(estimators.fit.innovations).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from estimators.fit.innovations import NoiseModel
from models.random.disturbance import parameters_of, power_share

Array = NDArray[np.float64]

STEP = 1e-3
"""Relative step of a correlation time, and step of the logarithm of a noise, for a numerical derivative."""


@dataclass(frozen=True, slots=True)
class StationaryStart:
    """Prior standard deviations `spread` (k,) of the initial states; that of a disturbance is its stationary one.

    `cost`: contribution, for each segment, of integrating over the initial states to the negative log-likelihood at the
    likeliest ones, and `slopes` (p + q,) its derivatives. Without it, the likelihood of a disturbance that begins at
    zero would grow without bound as its RMS goes to zero. `entries`: (index of the k, index of the unknown, derivative
    of the logarithm of the spread with respect to it).
    """

    spread: Array
    cost: float
    slopes: Array
    entries: tuple[tuple[int, int, float], ...]


def stationary_start(noise: NoiseModel, values: Array, logarithms: Array) -> StationaryStart:
    """Spread of the initial states at parameter values (np,) and logarithms (q,) of the noise."""
    spread, entries = _spreads(noise, values, logarithms)
    if not entries:
        return StationaryStart(spread, 0.0, np.zeros(len(noise.problem.free) + noise.size), ())
    cost, slopes = _integrated(noise, values, logarithms)
    return StationaryStart(spread, cost, slopes, entries)


def _spreads(noise: NoiseModel, values: Array, logarithms: Array) -> tuple[Array, tuple[tuple[int, int, float], ...]]:
    """`spread` and `entries` of StationaryStart."""
    task = noise.problem
    spread, entries = task.spread.copy(), []
    for number, place in enumerate(task.own):
        state = task.model.states[place]
        if not state.correlation_time:
            continue
        time = task.kernel.index(state.correlation_time)
        driving = next(each for each in task.model.states if each.name == (state.driven_by or state.name))
        which = noise.logarithm_of(driving.name)
        grown = 0.0 if which is None else float(logarithms[which])
        spread[number] = driving.process_noise * np.exp(grown) * np.sqrt(power_share(state) * values[time])
        if time in task.free:
            entries.append((number, task.free.index(time), 0.5 / float(values[time])))
        if which is not None:
            entries.append((number, len(task.free) + which, 1.0))
    return spread, tuple(entries)


def _integrated(noise: NoiseModel, values: Array, logarithms: Array) -> tuple[float, Array]:
    """`cost` and `slopes` of StationaryStart: half the logarithm of det(1 + D P), with P the prior covariance of the
    initial states and D the information of the record on them (Laplace's method, exact for a linear model)."""
    task = noise.problem
    its = parameters_of(task.model.base_states)
    times = [place for place, number in enumerate(task.free) if task.kernel.parameters[number] in its]
    unknowns = [*times, *range(len(task.free), len(task.free) + noise.size)]
    sizes = STEP * np.array([values[task.free[place]] for place in times] + [1.0] * noise.size)
    many_values = np.repeat(values[None], 1 + 2 * len(unknowns), axis=0)
    many_logarithms = np.repeat(logarithms[None], len(many_values), axis=0)
    for place, unknown in enumerate(unknowns):
        target = many_values if place < len(times) else many_logarithms
        column = task.free[unknown] if place < len(times) else unknown - len(task.free)
        target[1 + 2 * place, column] += sizes[place]
        target[2 + 2 * place, column] -= sizes[place]
    information = noise.start_information(many_values, many_logarithms)[:, list(task.own)][:, :, list(task.own)]
    spreads = np.stack([_spreads(noise, *each)[0] for each in zip(many_values, many_logarithms, strict=True)])
    inside = np.eye(len(task.own)) + spreads[:, :, None] * information * spreads[:, None, :]
    costs = 0.5 * np.linalg.slogdet(inside)[1]
    slopes = np.zeros(len(task.free) + noise.size)
    slopes[unknowns] = (costs[1::2] - costs[2::2]) / (2.0 * sizes)
    return float(costs[0]), slopes
