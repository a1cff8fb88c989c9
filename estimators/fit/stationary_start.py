"""Initial state of a segment: a disturbance begins stationary, and is integrated out of the likelihood.

    p(y) = integral of p(y | x0) p(x0) dx0,    -ln p(y) = -ln p(y | x0*) p(x0*) + 1/2 ln det(D + P^-1) + a constant

with x0* the likeliest initial state, P its prior covariance and D the information of the record on it. P depends on the
RMS of the disturbance, which is estimated. If the likelihood were maximised over x0 as well, it would grow without
bound as that RMS goes to zero. Laplace's method, exact for a linear model; D is that of a long record
(estimators.fit.innovations).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from upright.estimators.fit.innovations import NoiseModel, SteadyState
from upright.models.random.disturbance import power_share

Array = NDArray[np.float64]


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


def stationary_start(
    noise: NoiseModel, values: Array, logarithms: Array, steady: SteadyState, unknowns: Sequence[int]
) -> StationaryStart:
    """Spread of the initial states at parameter values (np,) and logarithms (q,) of the noise, where the filter is
    `steady`; `unknowns` are the free parameters and the logarithms among those that it is differentiated by."""
    spread, entries = _spreads(noise, values, logarithms)
    if not entries:
        return StationaryStart(spread, 0.0, np.zeros(len(unknowns)), ())
    rows, columns = np.ix_(noise.problem.own, noise.problem.own)
    information, slopes = steady.start_information(unknowns)
    both = spread[:, None] * spread
    inside = np.eye(len(spread)) + both * information[rows, columns]
    inverse = np.linalg.inv(inside)
    # Half the logarithm of det(1 + D P): Laplace's method, exact for a linear model.
    by = 0.5 * np.einsum("ij,mji->m", inverse, both * slopes[:, rows, columns])
    for number, unknown, slope in entries:
        by[unknown] += slope * (1.0 - inverse[number, number])
    return StationaryStart(spread, 0.5 * float(np.linalg.slogdet(inside)[1]), by, entries)


def stationary_spread(noise: NoiseModel, values: Array, logarithms: Array) -> Array:
    """`spread` of StationaryStart, (k,)."""
    return _spreads(noise, values, logarithms)[0]


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
