"""The error of a predictor some time ahead, and that of a correct model with the same sensors.

The filter follows a record; every few samples its state is propagated without correction, and the error is evaluated at
each horizon. There are two floors. For a correct model with the noise that it states (`floors`) the error consists of
the innovations e of covariance S that came in since, each propagated through the state that it corrected by the gain K,

    covariance(h) = S + sum over 0 < j < h of  D_j K S K' D_j',    D_j = d y(k + j) / d x(k),

with D_j differentiated along the record itself, so that friction counts as it is in motion and not as it is at rest.
The error from the sensors alone (`sensor_floors`) is smaller: R of the sample itself, the error P of the filtered state
due to their noise, and the part Q of that noise that a roll filter integrates on the way,

    covariance(h) = R + D_h P D_h' + sum over 0 < j < h of  D_j Q D_j'.

Process noise, by which a model admits that something is missing, enters there only through the filter's gain. The
exception is the disturbance (models.random.disturbance), which no model predicts: it is in Q and P as the fit estimated
it.
Source: Ljung, "System identification", 2nd ed., section 3.2.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from upright.diagnosis.lack_of_fit.floor import floor, sensor_noise
from upright.estimators.data.time_scale import time_scale
from upright.estimators.fit.gauss_newton import Block, Minimum, minimise
from upright.estimators.fit.innovations import NoiseModel
from upright.estimators.fit.maximum_likelihood import ENOUGH, Fit
from upright.estimators.fit.problem import Problem
from upright.estimators.fit.random.disturbance import densities
from upright.estimators.fit.stationary import stationary
from upright.models.compiler.kernel import Memory
from upright.models.segment import Segment

Array = NDArray[np.float64]

BEGINNING = 0.75
"""Time scales (estimators.data.time_scale; 0.3 s of the MONOCAB) from which the initial state is estimated first."""


def on(fit: Fit, task: Problem) -> Fit:
    """`fit` on the data of `task`, with its parameters and noise as they are; only the initial states are fitted.

    Otherwise the effect of the first sample's noise on the initial state would count as an error of the model. A state
    that is not measured is estimated from the first moments without the effects, then with them, then from all data:
    started at rest, it would be held there by friction.
    """
    weights = np.linalg.inv(np.linalg.cholesky(fit.covariance))
    task = task.like(fit.problem)
    beginning = BEGINNING * time_scale(task.model, task.segments)
    moments = replace(task, segments=tuple(_beginning(each, beginning) for each in task.segments))
    common = fit.minimum.common[: len(task.free)]
    amplitudes = {name for each in task.model.effects for name in each.amplitudes}
    bare = np.where([parameter.name in amplitudes for parameter in task.parameters], 0.0, common)
    nothing = np.zeros(0)

    def started(task: Problem, common: Array, own: Sequence[Array]) -> Minimum | None:
        def evaluate(_: Array, own: Sequence[Array]) -> list[Block] | None:
            return task.evaluate(common, own, weights=weights, gain=fit.gain, by_common=False)

        with np.errstate(all="ignore"):
            return minimise(evaluate, nothing, own, scale=nothing, lower=nothing, upper=nothing, enough=ENOUGH)

    own: Sequence[Array] = task.own_start
    for data, values in ((moments, bare), (moments, common)):
        first = started(data, values, own)
        own = own if first is None else first.own
    found = [each for each in (started(task, common, each) for each in (own, task.own_start)) if each is not None]
    best = min(found, key=lambda each: each.cost).own if found else tuple(task.own_start)
    return replace(fit, problem=task, minimum=replace(fit.minimum, own=(*best, nothing)))


def _beginning(segment: Segment, span: float) -> Segment:
    rows = max(3, int(np.searchsorted(segment.time, segment.time[0] + span)))
    columns = {name: getattr(segment, name)[:rows] for name in ("time", "knots", "inputs", "measured")}
    return replace(segment, **columns)


def errors(fit: Fit, horizons: Sequence[float]) -> list[Array]:
    """Measured less predicted, (m, ny) for each of `horizons` (s), from states that are one shortest horizon apart."""
    found: list[list[Array]] = [[] for _ in horizons]
    for segment, start in zip(fit.problem.segments, fit.starts, strict=True):
        steps = _steps(segment, horizons)
        predicted, nothing = np.empty_like(segment.measured), np.empty((*segment.measured.shape, 0))
        for row, memory in _filtered(fit, segment, start, min(steps)):
            reached = [step for step in steps if row + step < len(segment)]
            if not reached:
                break
            _free_run(fit, segment, row, row + max(reached), memory, (), predicted, nothing)
            for place, step in enumerate(steps):
                if row + step < len(segment):
                    found[place].append(segment.measured[row + step] - predicted[row + step])
    outputs = len(fit.problem.kernel.outputs)
    return [np.array(each).reshape(len(each), outputs) for each in found]


def times(fit: Fit, horizon: float) -> Array:
    """Times (s, (m,)) of the errors that `errors` gives for one `horizon` (s) alone."""
    found = []
    for segment in fit.problem.segments:
        (step,) = _steps(segment, (horizon,))
        found.append(segment.time[2 * step :: step])
    return np.concatenate(found)


def floors(fit: Fit, gain: Array, covariance: Array, horizons: Sequence[float]) -> Array:
    """RMS error of a correct model at each of `horizons` (s), (nh, ny), with its filter gain and innovation covariance.

    `fit` gives the trajectory along which an error of the state is propagated. `gain` (nx, ny), `covariance` (ny, ny).
    """
    kick = gain @ np.linalg.cholesky(covariance)
    return _carried(fit, np.zeros_like(kick), kick, covariance, horizons)


def sensor_floors(fit: Fit, horizons: Sequence[float], *, disturbed: bool = True) -> Array:
    """RMS error at each of `horizons` (s) from sensor noise and the disturbance alone, with the filter of `fit`, (nh,
    ny); without the disturbance if not `disturbed`."""
    return _carried(fit, *_sensor_errors(fit, disturbed), horizons)


def _carried(fit: Fit, begin: Array, each: Array, sensor: Array, horizons: Sequence[float]) -> Array:
    """RMS at each horizon, (nh, ny), of errors with the covariance roots `begin` (nx, .) at the start and `each` (nx,
    .) at every sample in between, and the covariance `sensor` (ny, ny) at the end."""
    kernel = fit.problem.kernel
    states, outputs = len(kernel.states), len(kernel.outputs)
    columns = tuple(len(kernel.parameters) + place for place in range(states))
    reached = _steps(fit.problem.segments[0], horizons)
    longest = max(reached)
    total: list[Array] = []
    for segment, start in zip(fit.problem.segments, fit.starts, strict=True):
        predicted = np.empty_like(segment.measured)
        slopes = np.empty((*segment.measured.shape, states))
        for row, memory in _filtered(fit, segment, start, longest):
            if row + longest >= len(segment):
                break
            _free_run(fit, segment, row, row + longest, memory, columns, predicted, slopes)
            ahead = slopes[row + 1 : row + 1 + longest]
            carried = np.sum((ahead @ begin) ** 2, axis=2)
            carried[1:] += np.cumsum(np.sum((ahead @ each) ** 2, axis=2), axis=0)[:-1]
            total.append(carried[[step - 1 for step in reached]])
    if not total:
        return np.full((len(horizons), outputs), np.nan)
    return np.asarray(np.sqrt(np.diag(sensor) + np.mean(total, axis=0)))


def _sensor_errors(fit: Fit, disturbed: bool) -> tuple[Array, Array, Array]:
    """Roots (nx, nx) of the covariance of the filtered state's error and of what a sample adds to it, both from sensor
    noise alone, and the covariance of that noise (ny, ny)."""
    task, values = fit.problem, fit.values.copy()
    # Linearised in motion: linearised at rest, friction has an enormous slope.
    values[[task.kernel.index(name) for each in task.model.effects for name in each.amplitudes]] = 0.0
    noise, known = NoiseModel.of(task), densities(fit) if disturbed else {}
    process = np.array([known.get(state.name, 0.0) for state in task.model.states])
    noise = replace(noise, sensor=sensor_noise(task)[0], process=process)
    transition, output, integrated, sensor, across = noise.covariances(values, np.zeros(noise.size))
    gain = fit.gain if disturbed else noise.gain(values, np.zeros(noise.size))
    gain = fit.gain if gain is None else gain
    if np.max(np.abs(np.linalg.eigvals(transition - transition @ gain @ output))) >= 1.0:
        gain = floor(task, values).gain
    ahead = transition @ gain
    driven = integrated + ahead @ sensor @ ahead.T - across @ ahead.T - ahead @ across.T
    state = stationary(transition - ahead @ output, driven)
    left = np.eye(len(state)) - gain @ output
    return _root(left @ state @ left.T + gain @ sensor @ gain.T), _root(integrated), sensor


def _root(covariance: Array) -> Array:
    values, vectors = np.linalg.eigh(0.5 * (covariance + covariance.T))
    return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0)))


def _steps(segment: Segment, horizons: Sequence[float]) -> list[int]:
    spacing = float(np.median(np.diff(segment.time)))
    return [max(1, round(horizon / spacing)) for horizon in horizons]


def _filtered(fit: Fit, segment: Segment, start: Array, stride: int) -> Iterator[tuple[int, Memory]]:
    """Every `stride` samples the filter's memory, its state corrected by that sample."""
    task, values = fit.problem, fit.values
    memory = task.kernel.memory(start)
    predicted, nothing = np.empty_like(segment.measured), np.empty((*segment.measured.shape, 0))
    row = 0
    while row + stride < len(segment):
        task.kernel.proceed(
            segment,
            values,
            memory,
            fit.gain,
            (),
            predicted,
            nothing,
            first=row,
            last=row + stride,
            substeps=task.substeps,
            skip=row > 0,
        )
        row += stride
        yield row, memory


def _free_run(
    fit: Fit, segment: Segment, first: int, last: int, memory: Memory, active: Sequence[int], out: Array, slopes: Array
) -> None:
    kernel = fit.problem.kernel
    ahead = kernel.memory(memory.x, active)
    ahead.lag[:], ahead.pointer[:] = memory.lag, memory.pointer
    substeps = fit.problem.substeps
    kernel.proceed(
        segment, fit.values, ahead, None, active, out, slopes, first=first, last=last, substeps=substeps, skip=True
    )
