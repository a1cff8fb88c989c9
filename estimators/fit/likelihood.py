"""How likely a record is under a model with noise: of parameters, of the noise and of each stretch's initial state.

    V = n/2 log det S + half the squares of what differs from the prior, in standard deviations,
    S = the mean of e e' over the n rows, and a floor; of what is counted at least a quantiser's variance

e are the innovations of the steady Kalman filter (estimators.fit.innovations). This is the negative logarithm of the
likelihood of Gaussian noise with the covariance that makes it most likely, so that no covariance has to be guessed. Its
derivatives are those of a sum of squares e' S^-1 e. Rows are condensed to products of their derivatives at once: what
is weighted is a small matrix. Source: Ljung, "System identification", 2nd ed., sections 7.4 and 15.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from estimators.fit.gauss_newton import Expansion, Normal
from estimators.fit.innovations import NoiseModel
from estimators.fit.long_run import LongRun, long_run
from estimators.fit.problem import Problem
from models.compiler.kernel import ELSEWHERE

Array = NDArray[np.float64]

FLOOR = 10.0
"""Times the known noise of a sensor below which its innovations are no information about the vehicle."""
RESOLUTION = 1e-5
"""Share of the movement of an output below which it is not told from another one that reads exactly like it, as both
wheels of a vehicle that is symmetric to the last bit do."""

DIVERGED = 1e15
"""Condition of the innovations' covariance beyond which a predictor has left the record, if not yet for infinity."""


@dataclass(frozen=True, slots=True)
class Seen(Expansion):
    """What is seen from a point, with the filter gain (nx, ny) and the innovations' covariance S (ny, ny) there."""

    gain: Array
    covariance: Array


@dataclass(frozen=True, slots=True)
class Likelihood:
    """V of parameters and logarithms of the noise, (p + q,): `prior` is 1/variance of these about `centre`."""

    task: Problem
    noise: NoiseModel
    centre: Array
    prior: Array

    @classmethod
    def of(cls, task: Problem, deviations: Array) -> Likelihood:
        """`deviations` (p,) are the standard deviations known before, 0 where there is none."""
        noise = NoiseModel.of(task)
        known = deviations > 0.0
        prior = np.concatenate((np.where(known, deviations, np.inf) ** -2.0, noise.spread**-2))
        return cls(task, noise, np.concatenate((task.start, np.zeros(noise.size))), prior)

    def __call__(self, common: Array, own: Sequence[Array]) -> Seen | None:
        """V at `common` (p + q,) and each stretch's own; None where the model runs away. The prior comes last, as if it
        were a stretch."""
        seen = self.of_data(common, own)
        if seen is None:
            return None
        off = common - self.centre
        prior = Normal(np.diag(self.prior), self.prior * off)
        return replace(seen, cost=seen.cost + 0.5 * float(off @ prior.vector), normals=(*seen.normals, prior))

    def of_data(self, common: Array, own: Sequence[Array], also: tuple[int, ...] = ()) -> Seen | None:
        """Without the prior. `also`: places of further parameters to differentiate by, after the logarithms."""
        task, noise, size = self.task, self.noise, len(self.task.free)
        task.budget.check()
        kernel, values, places = task.kernel, task.values(common[:size]), (*task.free, *also)
        typical = np.array([task.model.parameters[place].typical for place in places])
        found = noise.gain_and_slopes(values, common[size:], places, typical)
        if found is None:
            return None
        gain, slopes = found
        starts = [len(kernel.parameters) + state for state in task.own]
        active = (*task.free, *[ELSEWHERE] * noise.size, *also, *starts)
        order = np.r_[0:size, len(places) : len(places) + noise.size, size : len(places)]
        by_gain = np.concatenate((slopes[:, order], np.zeros((gain.size, len(starts)))), axis=1)
        squares, moments, ends = np.zeros((gain.shape[1],) * 2), [], []
        long_run = self.long_run(values, common[size:])
        spread = long_run.spread
        for segment, initial, part in zip(task.segments, task.initials, own, strict=False):
            start = initial.copy()
            start[list(task.own)] = part
            run = kernel.run(
                segment, values, start, gain=gain, gain_slopes=by_gain, active=active, substeps=task.substeps
            )
            if run.diverges:
                return None
            off, by = task.off_at_the_start(run, initial, part, range(len(active) - len(starts), len(active)))
            error = segment.measured - run.predicted
            unknown = ~np.isfinite(error)
            if unknown.any():
                error[unknown], run.sensitivity[unknown] = 0.0, 0.0
            columns = run.sensitivity.reshape(len(error), -1)
            squares += error.T @ error
            moments.append((columns.T @ columns, columns.T @ error))
            ends.append((off / spread, by / spread[:, None]))
        covariance = _at_least(squares / task.rows + np.diag(self._floor), self._counted)
        # In units of its own: a wheel that is stuck is no predictor that runs away.
        unit = np.sqrt(np.diag(covariance))
        if not np.all(np.isfinite(covariance)) or np.linalg.cond(covariance / np.outer(unit, unit)) > DIVERGED:
            return None
        weights = np.linalg.inv(covariance).astype(np.float64)
        normals = tuple(_weighted(*moment, weights, *end, long_run) for moment, end in zip(moments, ends, strict=True))
        surprise = sum(float(end @ end) for end, _ in ends)
        cost = 0.5 * task.rows * float(np.linalg.slogdet(covariance)[1]) + 0.5 * surprise
        if self._counted.any():
            # Where S is held above the mean of e e', the errors are fewer standard deviations than it has outputs.
            cost += 0.5 * (float(np.sum(weights * squares)) - task.rows * len(covariance))
        return Seen(cost + len(ends) * long_run.cost, normals, gain, covariance)

    def long_run(self, values: Array, logarithms: Array) -> LongRun:
        """What the initial states may be off by at parameter values (np,) and logarithms (q,) of the noise."""
        return long_run(self.noise, values, logarithms)

    @property
    def _counted(self) -> Array:
        """The least variance of the innovations of each output, (ny,): that of a quantiser; 0 where none is known."""
        outputs = self.task.model.outputs
        return np.array([output.noise**2 if output.counted and not output.noise_known else 0.0 for output in outputs])

    @property
    def _floor(self) -> Array:
        """What is added to the innovations' variances, (ny,)."""
        outputs = self.task.model.outputs
        known = np.array([(FLOOR if output.noise_known else 1e-9) * output.noise for output in outputs])
        alike = np.zeros(len(outputs))
        for place in self.noise.copies:
            alike[place] = RESOLUTION * np.nanstd(
                np.concatenate([each.measured[:, place] for each in self.task.segments])
            )
        return np.asarray(known**2 + alike**2)


def _at_least(covariance: Array, least: Array) -> Array:
    """The likeliest covariance S (ny, ny) in which no combination of counted outputs has less than the variances
    `least` (ny,) that a quantiser makes, once the other outputs are known; the mean of e e' is `covariance`.

    In units of `least`, what has a variance below one gets one. While an encoder does not count, errors vanish; were
    they taken for what it is good to, a fit would follow its steps. Two that count at the same rows differ by nothing.
    A quantiser's error has to do with no other sensor's, so all covariances with those stay as they are.
    """
    held = np.flatnonzero(least > 0.0)
    if not len(held) or not np.all(np.isfinite(covariance)):
        return covariance
    others = np.flatnonzero(least <= 0.0)
    across, unit = covariance[np.ix_(others, held)], np.sqrt(least[held])
    left = covariance[np.ix_(held, held)]
    if len(others):
        left = left - across.T @ np.linalg.lstsq(covariance[np.ix_(others, others)], across, rcond=None)[0]
    squares, turned = np.linalg.eigh(left / np.outer(unit, unit))
    more = (turned * np.maximum(1.0 - squares, 0.0)) @ turned.T
    found = covariance.copy()
    found[np.ix_(held, held)] += more * np.outer(unit, unit)
    return found


def _weighted(products: Array, pull: Array, weights: Array, end: Array, by: Array, long_run: LongRun) -> Normal:
    """The normal equations of a stretch.

    `products` (ny * c, ny * c) are of its columns, `pull` (ny * c, ny) of these with its errors; the last columns are
    the initial state's, which is off by `end` (k,) times its spread in the `long_run`; `by` (k, c) are the derivatives.
    """
    outputs = len(weights)
    columns = len(pull) // outputs
    four = products.reshape(outputs, columns, outputs, columns)
    matrix = np.einsum("jakb,jk->ab", four, weights)
    vector = -np.einsum("jak,jk->a", pull.reshape(outputs, columns, outputs), weights)
    off = by.copy()
    for number, unknown, slope in long_run.entries:
        off[number, unknown] = -end[number] * slope
    vector[: len(long_run.slopes)] += long_run.slopes
    return Normal(matrix + off.T @ off, vector + off.T @ end)
