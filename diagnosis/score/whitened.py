"""The whitened innovations of a fit, and their response to parameters, noise and effects.

With weights W (ny, ny), W' W the inverse of their covariance, z = W e is white if the model is right. The derivatives
of z with respect to all that is fitted anyway are its nuisances; only the part of an effect's derivative that is
orthogonal to them can be determined from the record. Source: Ljung, "System identification", 2nd ed., sections 7.4 and
16.4.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from upright.estimators.data.time_scale import time_scale
from upright.estimators.fit.gauss_newton import Block
from upright.estimators.fit.innovations import NoiseModel
from upright.estimators.fit.maximum_likelihood import Fit
from upright.estimators.fit.problem import Problem
from upright.models.segment import Segment

Array = NDArray[np.float64]

BLOCK = 1.25
"""Time scales (estimators.data.time_scale) over which innovations that are not white are grouped: 0.5 s of the
MONOCAB."""
FINEST = 32
"""Steps per sample, at most."""
SAME = 3e-7
"""Share of the largest singular value below which a direction is a rounding error."""


@dataclass(frozen=True, slots=True)
class Whitened:
    """The whitened innovations of a fit, and their response to the nuisances.

    `residual` (n + k,), all nuisances projected out, its last `priors` = k rows the deviations of these from their
    priors; `blocks` (n + k,) numbers the blocks of time, and each of the last rows; `starts`, by segment, an
    orthonormal basis of the response to its initial state; `nuisance` (n + k, p), a basis of the response to the
    nuisances beyond that.
    """

    fit: Fit
    residual: Array
    blocks: NDArray[np.int64]
    starts: tuple[Array, ...]
    nuisance: Array
    priors: int

    @classmethod
    def of(cls, fitted: Fit) -> Whitened:
        """Raises ArithmeticError if the fit ended where the model diverges."""
        task, noise = fitted.problem, NoiseModel.of(fitted.problem)
        held, size = task.uncertain, len(task.free)
        typical = np.array([task.model.parameters[place].typical for place in (*task.free, *held)])
        steady = noise.steady_state(fitted.values, fitted.minimum.common[size:], (*task.free, *held), typical)
        blocks = task.evaluate(
            fitted.minimum.common[:size],
            fitted.minimum.own[: len(task.segments)],
            weights=whitening(fitted),
            gain=fitted.gain,
            slopes=None if steady is None else steady.slopes,
            also=held,
        )
        if steady is None or blocks is None:
            raise ArithmeticError("the model diverges where its own fit ended")
        bases = [np.linalg.qr(block.own)[0] for block in blocks]
        columns = np.concatenate([less(block.common, basis) for block, basis in zip(blocks, bases, strict=True)])
        residual = np.concatenate([less(block.residual, basis) for block, basis in zip(blocks, bases, strict=True)])
        deviations = np.array([task.model.parameters[place].std for place in held])
        known = size + len(held)
        prior = np.zeros(columns.shape[1])
        prior[:size], prior[known:] = np.sqrt(fitted.prior[:size]), np.sqrt(fitted.prior[size:])
        prior[size:known] = 1.0 / deviations
        nuisance = orthonormal(np.concatenate((columns, np.diag(prior))))
        off = np.zeros(columns.shape[1])
        off[:size] = fitted.minimum.common[:size] - task.start
        off[known:] = fitted.minimum.common[size:]
        # A parameter that the data pull away from its prior costs likelihood, which an effect doing the same can
        # recover.
        residual = project(np.concatenate((residual, prior * off))[:, None], nuisance)[:, 0]
        numbers = _blocks(task, blocks)
        numbers = np.concatenate((numbers, numbers[-1] + 1 + np.arange(len(prior))))
        return cls(fitted, residual, numbers, tuple(bases), nuisance, len(prior))

    def directions(self, full: Problem, amplitudes: Sequence[str], shape: Mapping[str, float]) -> Array:
        """Response of the innovations to a unit of each of `amplitudes`, (n, m), with the nuisances still in it.

        `full` is the problem of the model with the effects, on the same samples.
        """
        moved = self.moved(full, amplitudes, shape)
        return np.concatenate([less(rows, basis) for rows, basis in zip(moved, self.starts, strict=True)])

    def moved(self, full: Problem, amplitudes: Sequence[str], shape: Mapping[str, float]) -> list[Array]:
        """The same by segment, including what the initial state can explain; one sample after the other, then the
        deviations of the initial state."""
        task = self.fit.problem
        known = dict(zip(task.kernel.parameters, self.fit.values.tolist(), strict=True))
        neutral = {p.name: p.value for p in full.model.parameters if p.name not in known} | dict.fromkeys(
            amplitudes, 0.0
        )
        values = full.kernel.vector({**neutral, **known, **shape})
        active = [full.kernel.index(name) for name in amplitudes]
        gain, slopes = self._followed(full, values, active)
        weights = whitening(self.fit)
        parts = []
        for segment, start, further, basis in zip(
            full.segments, self.fit.starts, full.initials, self.starts, strict=True
        ):
            initial = np.concatenate((start, further[len(start) :]))
            # A state that is fast only when the vehicle moves fast does not show in the poles at rest.
            substeps = max(full.substeps, task.substeps)
            passed = partial(full.kernel.run, segment, values, initial, gain=gain, gain_slopes=slopes, active=active)
            run = passed(substeps=substeps)
            while not np.all(np.isfinite(run.sensitivity)) and substeps < FINEST:
                substeps *= 2
                run = passed(substeps=substeps)
            moved = np.where(np.isfinite(segment.measured)[:, :, None], run.sensitivity, 0.0)
            rows = (weights @ moved).reshape(-1, len(active))
            begun = np.zeros((len(basis) - len(rows), len(active)))
            # How the effects change the initial state that the first sample shows.
            for number, output in task.shown:
                begun[number] = run.sensitivity[0, output] / task.spread[number]
            parts.append(np.concatenate((rows, begun)))
        return parts

    def _followed(self, full: Problem, values: Array, active: Sequence[int]) -> tuple[Array, Array | None]:
        """The gain of the model of `full` at `values` (np,) with the noise of the fit, and its derivatives with respect
        to the amplitudes that are `active`: an effect that delays readings also changes their noise. If there is no
        such filter, the gain of the fit, and None."""
        noise = NoiseModel.of(full)
        logarithms = self.fit.minimum.common[len(self.fit.problem.free) :]
        if noise.size == len(logarithms):
            typical = np.array([full.model.parameters[place].typical for place in active])
            found = noise.steady_state(values, logarithms, active, typical)
            if found is not None and np.all(np.isfinite(found.slopes)):
                return found.gain, np.ascontiguousarray(found.slopes[:, : len(active)])
        gain = np.zeros((len(full.kernel.states), len(full.kernel.outputs)))
        gain[: len(self.fit.gain)] = self.fit.gain
        return gain, None


PEAKS = 3
FINER = 8
"""Frequencies that are searched for each one that the record can resolve."""
SLOWEST = 0.04
"""Divided by the time scale, Hz, the lowest frequency of a peak in the spectrum that is considered."""


def peaks(innovations: Whitened) -> tuple[list[float], int]:
    """Frequencies, Hz, at which the innovations have most power, where a spectral line or a mode would be; and the
    number from which they were chosen."""
    task = innovations.fit.problem
    segment, rows = of_longest(innovations)
    window = np.hanning(len(rows))[:, None]
    # Between the frequencies of the record, too: half a bin off, a spectral line that lasts the whole record hardly
    # shows.
    padded = FINER * len(rows)
    power = np.sum(np.abs(np.fft.rfft(rows * window, padded, axis=0)) ** 2, axis=1)
    frequency = np.fft.rfftfreq(padded, float(np.median(np.diff(segment.time))))
    power[frequency < SLOWEST / time_scale(task.model, task.segments)] = 0.0
    found: list[float] = []
    for place in np.argsort(power)[::-1]:
        if all(abs(frequency[place] - other) > 2.0 / segment.duration for other in found):
            found.append(float(frequency[place]))
        if len(found) == PEAKS:
            break
    return found, len(rows) // 2 + 1


def of_longest(innovations: Whitened) -> tuple[Segment, Array]:
    """The longest segment, and its whitened innovations (n, ny)."""
    task = innovations.fit.problem
    outputs = len(task.kernel.outputs)
    longest = int(np.argmax([len(segment) for segment in task.segments]))
    before = sum(len(segment) * outputs + len(task.own) for segment in task.segments[:longest])
    segment = task.segments[longest]
    return segment, innovations.residual[before : before + len(segment) * outputs].reshape(-1, outputs)


def whitening(fitted: Fit) -> Array:
    """The matrix that makes innovations independent and of unit variance, (ny, ny)."""
    return np.asarray(np.linalg.inv(np.linalg.cholesky(fitted.covariance)))


def orthonormal(columns: Array) -> Array:
    """A basis (n, r) of the span of `columns` (n, p), r <= p: columns that are identical to rounding count once."""
    basis, mixed = np.linalg.qr(columns / np.maximum(np.linalg.norm(columns, axis=0), 1e-300))
    directions, sizes, _ = np.linalg.svd(mixed)
    return np.asarray(basis @ directions[:, sizes > SAME * sizes[0]])


def project(columns: Array, nuisance: Array) -> Array:
    """`columns` (n or n + k, m) minus their projection on the basis of nuisances (n + k, p), k rows of priors last,
    (n + k, m)."""
    return less(np.concatenate((columns, np.zeros((len(nuisance) - len(columns), columns.shape[1])))), nuisance)


def less(columns: Array, basis: Array) -> Array:
    """`columns` (n, m) minus their projection on the orthonormal `basis` (n, p)."""
    return np.asarray(columns - basis @ (basis.T @ columns))


def _blocks(task: Problem, evaluated: Sequence[Block]) -> NDArray[np.int64]:
    """The block of time to which each row belongs; rows for the deviation of an initial state belong to the first."""
    numbers, following = [], 0
    length = BLOCK * time_scale(task.model, task.segments)
    for segment, block in zip(task.segments, evaluated, strict=True):
        number = ((segment.time - segment.time[0]) / length).astype(np.int64)
        rows = np.repeat(number, len(task.kernel.outputs))
        numbers.append(following + np.concatenate((rows, np.zeros(len(block.residual) - len(rows), dtype=np.int64))))
        following += int(number[-1]) + 1
    return np.concatenate(numbers)
