"""Negative log-likelihood of a record under a model with noise, as a function of parameters, noise and the initial
state of each segment.

    V = n/2 log det S + half the sum of squared deviations from the prior, in standard deviations,
    S = the mean of e e' over the n samples, plus a floor; for counted outputs at least a quantiser's variance

e are the innovations of the steady-state Kalman filter (estimators.fit.innovations). V is the negative log-likelihood
of Gaussian noise, maximised over its covariance, so that no covariance has to be assumed. Its derivatives are those of
a sum of squares e' S^-1 e. Samples are reduced at once to products of their derivatives, so that only a small matrix is
weighted. Source: Ljung, "System identification", 2nd ed., sections 7.4 and 15.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from upright.estimators.fit.gauss_newton import Expansion, Normal
from upright.estimators.fit.innovations import NoiseModel
from upright.estimators.fit.problem import Problem
from upright.estimators.fit.stationary_start import StationaryStart, stationary_start
from upright.models.compiler.kernel import ELSEWHERE

Array = NDArray[np.float64]

FLOOR = 10.0
"""Innovations below this factor of a sensor's known noise carry no information about the vehicle."""
DIVERGED = 1e15
"""Condition number of the innovations' covariance above which a predictor has diverged, even if it is still finite."""


@dataclass(frozen=True, slots=True)
class Seen(Expansion):
    """The expansion at a point, with the filter gain (nx, ny) and the innovations' covariance S (ny, ny) there."""

    gain: Array
    covariance: Array


@dataclass(frozen=True, slots=True)
class Likelihood:
    """V as a function of parameters and logarithms of the noise, (p + q,). `prior` is 1/variance of these about
    `centre`."""

    task: Problem
    noise: NoiseModel
    centre: Array
    prior: Array

    @classmethod
    def of(cls, task: Problem, deviations: Array) -> Likelihood:
        """`deviations` (p,) are the prior standard deviations of the parameters, 0 for no prior."""
        noise = NoiseModel.of(task)
        known = deviations > 0.0
        prior = np.concatenate((np.where(known, deviations, np.inf) ** -2.0, noise.spread**-2))
        return cls(task, noise, np.concatenate((task.start, np.zeros(noise.size))), prior)

    def __call__(self, common: Array, own: Sequence[Array]) -> Seen | None:
        """V at `common` (p + q,) and at each segment's own unknowns; None if the model diverges. The prior comes last,
        in the form of a segment."""
        seen = self.of_data(common, own)
        if seen is None:
            return None
        off = common - self.centre
        prior = Normal(np.diag(self.prior), self.prior * off)
        return replace(seen, cost=seen.cost + 0.5 * float(off @ prior.vector), normals=(*seen.normals, prior))

    def held(self, common: Array) -> Likelihood:
        """V as a function of the logarithms of the noise alone, (q,), with the parameters held as in `common` (p + q,):
        its passes have fewer columns."""
        size = len(self.task.free)
        values = self.task.values(common[:size])
        task = replace(self.task, kernel=replace(self.task.kernel, defaults=values), free=())
        return Likelihood(task, replace(self.noise, problem=task), self.centre[size:], self.prior[size:])

    def is_finite(self, common: Array, own: Sequence[Array]) -> bool:
        """Whether the predictor exists and does not diverge there, from passes without derivatives."""
        task, size = self.task, len(self.task.free)
        task.budget.check()
        values = task.values(common[:size])
        gain = self.noise.gain(values, common[size:])
        return gain is not None and not any(
            task.kernel.run(segment, values, task.begin(initial, part), gain=gain, substeps=task.substeps).diverges
            for segment, initial, part in zip(task.segments, task.initials, own, strict=False)
        )

    def of_data(self, common: Array, own: Sequence[Array], also: tuple[int, ...] = ()) -> Seen | None:
        """V without the prior. `also`: indices of further parameters to differentiate by, after the logarithms."""
        task, noise, size = self.task, self.noise, len(self.task.free)
        task.budget.check()
        kernel, values, places = task.kernel, task.values(common[:size]), (*task.free, *also)
        typical = np.array([task.model.parameters[place].typical for place in places])
        steady = noise.steady_state(values, common[size:], places, typical)
        if steady is None:
            return None
        gain = steady.gain
        starts = [len(kernel.parameters) + state for state in task.own]
        active = (*task.free, *[ELSEWHERE] * noise.size, *also, *starts)
        order = np.r_[0:size, len(places) : len(places) + noise.size, size : len(places)]
        by_gain = np.concatenate((steady.slopes[:, order], np.zeros((gain.size, len(starts)))), axis=1)
        squares, moments, ends = np.zeros((gain.shape[1],) * 2), [], []
        at_start = stationary_start(noise, values, common[size:], steady, order[: size + noise.size])
        spread = at_start.spread
        for segment, initial, part in zip(task.segments, task.initials, own, strict=False):
            start = task.begin(initial, part)
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
            products = _products(columns)
            squares += error.T @ error
            moments.append((products, columns.T @ error))
            ends.append((off / spread, by / spread[:, None]))
        covariance = _at_least(squares / task.rows + np.diag(self._floor), self._counted)
        # Each output in its own unit: a stuck wheel does not mean that the predictor diverges.
        unit = np.sqrt(np.diag(covariance))
        if not np.all(np.isfinite(covariance)) or np.linalg.cond(covariance / np.outer(unit, unit)) > DIVERGED:
            return None
        weights = np.linalg.inv(covariance).astype(np.float64)
        normals = tuple(_weighted(*moment, weights, *end, at_start) for moment, end in zip(moments, ends, strict=True))
        surprise = sum(float(end @ end) for end, _ in ends)
        cost = 0.5 * task.rows * float(np.linalg.slogdet(covariance)[1]) + 0.5 * surprise
        if self._counted.any():
            # If S is held above the mean of e e', the weighted squares sum to less than samples times outputs.
            cost += 0.5 * (float(np.sum(weights * squares)) - task.rows * len(covariance))
        return Seen(cost + len(ends) * at_start.cost, normals, gain, covariance)

    @property
    def _counted(self) -> Array:
        """Lower bound of the innovations' variance of each output, (ny,): that of a quantiser; 0 without a bound."""
        outputs = self.task.model.outputs
        return np.array([output.noise**2 if output.counted and not output.noise_known else 0.0 for output in outputs])

    @property
    def _floor(self) -> Array:
        """Floor that is added to the innovations' variances, (ny,)."""
        outputs = self.task.model.outputs
        known = np.array([(FLOOR if output.noise_known else 1e-9) * output.noise for output in outputs])
        return np.asarray(known**2 + self.noise.added**2)


def _at_least(covariance: Array, least: Array) -> Array:
    """The likeliest covariance S (ny, ny) in which, given the other outputs, no combination of counted outputs has less
    than a quantiser's variance `least` (ny,); `covariance` is the mean of e e'.

    In units of `least`, combinations with a variance below one get one. While an encoder does not count, errors vanish;
    if that were taken for its accuracy, a fit would follow its steps. Two encoders that count at the same samples have
    no difference at all. The error of a quantiser is independent of the other sensors, so the covariances with those
    are unchanged.
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


def _products(columns: Array) -> Array:
    """The products of all `columns` (n, ny * c) with each other, (ny * c, ny * c). A sample that alone has more than
    half of the sum of squares of a segment, in the mean over the columns, is set to zero in place. Repeated until there
    is none.

    Where parts collide, derivatives grow from impact to impact, now and then by more digits than a number has. They
    hold for changes far below any standard deviation, and in the products the other samples would be lost in rounding.
    """
    while True:
        products = columns.T @ columns
        total = np.diag(products)
        there = total > 0.0
        weights = np.divide(1.0, total, out=np.zeros_like(total), where=there)
        away = np.einsum("ij,ij,j->i", columns, columns, weights) > 0.5 * np.count_nonzero(there)
        if not away.any():
            return np.asarray(products)
        columns[away] = 0.0


def _weighted(products: Array, pull: Array, weights: Array, end: Array, by: Array, at_start: StationaryStart) -> Normal:
    """The normal equations of a segment.

    `products` (ny * c, ny * c) are those of its columns, `pull` (ny * c, ny) those of its columns with its errors. The
    last columns are those of the initial state, which deviates by `end` (k,) times its spread in `at_start`; `by`
    (k, c) are the derivatives of `end`.
    """
    outputs = len(weights)
    columns = len(pull) // outputs
    four = products.reshape(outputs, columns, outputs, columns)
    matrix = np.einsum("jakb,jk->ab", four, weights)
    vector = -np.einsum("jak,jk->a", pull.reshape(outputs, columns, outputs), weights)
    off = by.copy()
    for number, unknown, slope in at_start.entries:
        off[number, unknown] = -end[number] * slope
    vector[: len(at_start.slopes)] += at_start.slopes
    return Normal(matrix + off.T @ off, vector + off.T @ end)
