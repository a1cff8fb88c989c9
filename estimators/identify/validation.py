"""Validation of a fitted model on held-out recordings: one step ahead, some time ahead, and in simulation.

Each figure is 100 % minus the error over the channel's own variation about its mean, both RMS: 100 is perfect, 0 is no
better than the mean. One step ahead, every sample is predicted from all previous ones; a simulation uses the inputs
only.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from upright.estimators.fit.maximum_likelihood import Fit
from upright.estimators.fit.problem import Problem, problem
from upright.estimators.methods.prediction_error import predicted_percent
from upright.models.segment import Segment
from upright.telemetry.recording import Recording

Array = NDArray[np.float64]

HORIZON = 0.5
"""Default horizon, s."""


@dataclass(frozen=True, slots=True)
class Validation:
    """Percent by channel: `one_step`, `ahead` (`horizon` s) and `simulation`; `error` is the simulation's, RMS.

    By segment: `time` s (n,), `measured` and `simulated` (n, ny), from the beginning of the simulation.
    """

    horizon: float
    one_step: Mapping[str, float]
    ahead: Mapping[str, float]
    simulation: Mapping[str, float]
    error: Mapping[str, float]
    time: tuple[Array, ...]
    measured: tuple[Array, ...]
    simulated: tuple[Array, ...]

    def __str__(self) -> str:
        lines = [
            f"  {name:20} one step {self.one_step[name]:.2f} %, {self.horizon:g} s ahead {self.ahead[name]:.1f} %, "
            f"simulation {self.simulation[name]:.1f} %"
            for name in self.one_step
        ]
        return "\n".join(lines)


def validate(
    fitted: Fit,
    recordings: Sequence[Recording],
    *,
    values: Mapping[str, float] | None = None,
    support: float | None = None,
    horizon: float = HORIZON,
    settle: float = 0.0,
) -> Validation:
    """Validation of `fitted` on `recordings`, with `values` instead of some of its own.

    A simulation starts from the measured state at the first sample or, with `settle` > 0 s, from the filtered state
    after that time. Raises DataError if the recordings cannot be used.
    """
    there = on_others(fitted, recordings, values=values, support=support)
    task, kernel = there.problem, there.problem.kernel
    starts = [min(int(np.searchsorted(segment.time, settle)), len(segment) - 2) for segment in task.segments]
    innovations = [error[start + 1 :] for error, start in zip(there.innovations(), starts, strict=True)]
    parts = [_simulated(there, *each) for each in zip(task.segments, there.starts, starts, strict=True)]
    measured = [segment.measured[start:] for segment, start in zip(task.segments, starts, strict=True)]
    errors = [shown - part for shown, part in zip(measured, parts, strict=True)]
    rms = np.sqrt(np.nanmean(np.concatenate(errors) ** 2, axis=0))
    return Validation(
        horizon=horizon,
        one_step=_percent(task, innovations, measured),
        ahead=predicted_percent(there, horizon),
        simulation=_percent(task, errors, measured),
        error=dict(zip(kernel.outputs, rms.tolist(), strict=True)),
        time=tuple(segment.time[start:] for segment, start in zip(task.segments, starts, strict=True)),
        measured=tuple(measured),
        simulated=tuple(parts),
    )


def on_others(
    fitted: Fit,
    recordings: Sequence[Recording],
    *,
    values: Mapping[str, float] | None = None,
    support: float | None = None,
) -> Fit:
    """`fitted` unchanged, except for `values`, on `recordings`: nothing is fitted again.

    Raises DataError if the recordings cannot be used.
    """
    kernel = fitted.problem.kernel
    own = dict(zip(kernel.parameters, fitted.values.tolist(), strict=True)) | dict(values or {})
    task = problem(fitted.problem.model.change(own), recordings, support=support)
    common = np.concatenate((task.start, fitted.minimum.common[len(task.free) :]))
    return replace(
        fitted, problem=task, minimum=replace(fitted.minimum, common=common, own=tuple(task.own_start)), steps=()
    )


def in_windows(fitted: Fit, horizon: float) -> list[Array]:
    """Consecutive simulations of `horizon` s, each from the filtered state at the end of the previous one.

    By segment, (n, ny); NaN over the first horizon, in which the filter settles.
    """
    task, values = fitted.problem, fitted.values
    found = []
    for segment, start in zip(task.segments, fitted.starts, strict=True):
        steps = round(horizon / float(np.median(np.diff(segment.time))))
        simulated, other = np.full_like(segment.measured, np.nan), np.empty_like(segment.measured)
        nothing = np.empty((*segment.measured.shape, 0))
        filtered, free = task.kernel.memory(start), task.kernel.memory(start)
        correct = task.kernel.ready(segment, values, filtered, fitted.gain, (), other, nothing, substeps=task.substeps)
        simulate = task.kernel.ready(segment, values, free, None, (), simulated, nothing, substeps=task.substeps)
        for row in range(0, len(segment) - steps, steps):
            if row > 0:
                free.x[:], free.lag[:], free.pointer[:] = filtered.x, filtered.lag, filtered.pointer
                simulate(row, row + steps, True)
            correct(row, row + steps, row > 0)
        simulated[: steps + 1] = np.nan
        found.append(simulated)
    return found


def _simulated(fitted: Fit, segment: Segment, initial: Array, start: int) -> Array:
    """Filtered up to sample `start`, simulated from there: (n - start, ny)."""
    task, values = fitted.problem, fitted.values
    memory = task.kernel.memory(initial)
    predicted = np.empty_like(segment.measured)
    nothing = np.empty((*segment.measured.shape, 0))
    if start > 0:
        task.kernel.proceed(
            segment, values, memory, fitted.gain, (), predicted, nothing, last=start, substeps=task.substeps
        )
    task.kernel.proceed(
        segment, values, memory, None, (), predicted, nothing, first=start, substeps=task.substeps, skip=start > 0
    )
    return predicted[start:]


def _percent(task: Problem, errors: Sequence[Array], measured: Sequence[Array]) -> dict[str, float]:
    error, shown = np.concatenate(errors), np.concatenate(measured)
    share = np.sqrt(np.nanmean(error**2, axis=0)) / np.maximum(np.nanstd(shown, axis=0), 1e-300)
    return {name: float(100.0 * (1.0 - each)) for name, each in zip(task.kernel.outputs, share, strict=True)}
