"""Measured against predicted some time ahead, from the filtered state every quarter of a time scale.

For a correct model the error is due to noise alone: the innovations e of covariance S that came in since, each
propagated through the state that it corrected,

    covariance(h) = S + sum over j < h of  D_j K S K' D_j',    D_j = d y(k + j) / d x(k),

with D_j differentiated along the record, so that friction counts as it is in motion. For an unstable plant it grows
with the poles, so that only the ratio of error and floor is meaningful. Source: Ljung, "System identification", 2nd
ed., section 3.2.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from upright.diagnosis.lack_of_fit.floor import Innovations
from upright.estimators.data.time_scale import time_scale
from upright.models.natural_time import rounded

Array = NDArray[np.float64]

HORIZONS = (0.125, 0.5, 1.25, 5.0)
"""Time scales (estimators.data.time_scale) that predictions reach ahead, if a segment of the record is more than twice
as long: 0.05, 0.2, 0.5 and 2 s of the MONOCAB."""
STRIDE = 0.25
"""Time scales between the states that predictions start from."""


@dataclass(frozen=True, slots=True)
class Prediction:
    """At `horizon` s ahead: `time` (m,), `measured` and `predicted` (m,) by channel, and the `floor` of their RMS
    difference. `segment` (m,) numbers gapless segments; time is s from their recording's first sample."""

    horizon: float
    time: Array
    segment: NDArray[np.int64]
    measured: Mapping[str, Array]
    predicted: Mapping[str, Array]
    floor: Mapping[str, float]

    def rmse(self, channel: str) -> float:
        """Root mean square prediction error of `channel`."""
        return float(np.sqrt(np.nanmean((self.measured[channel] - self.predicted[channel]) ** 2)))

    def fit_percent(self, channel: str) -> float:
        """100 % less the prediction error over the channel's own movement about its mean, both RMS."""
        return float(100.0 * (1.0 - self.rmse(channel) / max(float(np.nanstd(self.measured[channel])), 1e-300)))


def predictions(found: Innovations) -> list[Prediction]:
    """One entry for each of HORIZONS that the record is long enough for."""
    scale = time_scale(found.problem.model, found.problem.segments)
    longest = max(segment.duration for segment in found.problem.segments)
    reached = [rounded(each * scale) for each in HORIZONS if 2.0 * each * scale < longest]
    if not reached:
        return []
    steps = [max(1, round(horizon / found.floor.spacing)) for horizon in reached]
    rows: list[list[tuple[int, float, Array, Array]]] = [[] for _ in reached]
    carried = []
    kick = found.floor.gain @ np.linalg.cholesky(found.floor.covariance)
    for number, segment in enumerate(found.problem.segments):
        for row, predicted, slopes in _free_runs(found, number, max(steps), STRIDE * scale):
            for entries, step in zip(rows, steps, strict=True):
                at = row + step
                if at < len(segment):
                    entries.append((number, float(segment.time[at]), segment.measured[at], predicted[at].copy()))
            if slopes is not None and row + max(steps) < len(segment):
                carried.append(np.sum((slopes[row + 1 : row + max(steps)] @ kick) ** 2, axis=2))
    grown = np.cumsum(np.mean(carried, axis=0), axis=0)
    grown = np.vstack((np.zeros((1, grown.shape[1])), grown))
    names = found.problem.kernel.outputs
    results = []
    for horizon, step, entries in zip(reached, steps, rows, strict=True):
        numbers, time, measured, ahead = (np.array(column) for column in zip(*entries, strict=True))
        floor = np.sqrt(np.diag(found.floor.covariance) + grown[step - 1])
        results.append(
            Prediction(
                horizon=horizon,
                time=time,
                segment=numbers,
                measured=dict(zip(names, measured.T, strict=True)),
                predicted=dict(zip(names, ahead.T, strict=True)),
                floor=dict(zip(names, map(float, floor), strict=True)),
            )
        )
    return results


def _free_runs(found: Innovations, number: int, rows: int, every: float) -> Iterator[tuple[int, Array, Array | None]]:
    """Every `every` s of a segment, a prediction over `rows` samples without correction: the sample, the predicted
    outputs (n, ny) and, once in so many samples, their derivatives with respect to the state there (n, ny, nx). The
    arrays are reused."""
    task, fit = found.problem, found.fit
    kernel, segment = task.kernel, task.segments[number]
    states, stride = len(kernel.states), max(1, round(every / found.floor.spacing))
    columns = tuple(len(kernel.parameters) + place for place in range(states))
    filtered, predicted = kernel.memory(fit.starts[number]), np.empty_like(segment.measured)
    nothing, slopes = np.empty((*segment.measured.shape, 0)), np.empty((*segment.measured.shape, states))
    row, due = 0, 0
    while row + stride + 1 < len(segment):
        kernel.proceed(
            segment,
            fit.values,
            filtered,
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
        differentiated = row >= due
        active = columns if differentiated else ()
        ahead = kernel.memory(filtered.x, active)
        ahead.lag[:], ahead.pointer[:] = filtered.lag, filtered.pointer
        out = slopes if differentiated else nothing
        last = min(row + rows, len(segment) - 1)
        kernel.proceed(
            segment,
            fit.values,
            ahead,
            None,
            active,
            predicted,
            out,
            first=row,
            last=last,
            substeps=task.substeps,
            skip=True,
        )
        yield row, predicted, slopes if differentiated else None
        if differentiated:
            due = row + rows
