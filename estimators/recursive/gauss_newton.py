"""Recursive least squares for a locally linear model: the core of a recursive prediction error method.

Residuals r (m,) of unit variance, with derivatives J of the prediction with respect to the unknowns z, satisfy
r + J z = J z* + noise  for the true z*. These equations are accumulated in information form and solved with the prior
after every chunk,

    information = sum of w J'J,   right = sum of w J'(r + J z),   z = (information + prior)^-1 right,

the Gauss-Newton recursion of Ljung, "System identification", 2nd ed., section 11.5, for chunks instead of samples. The
prior is never forgotten, so that the covariance stays bounded without excitation; z is relative to its centre. Each
gapless segment has unknowns of its own, its initial state, which are eliminated when it ends.

With weights w that fall with age, or residuals that are correlated within a chunk, the covariance of z is
information^-1 meat information^-1,  where meat is that of `right`: the sum of w^2 J'J, or of w^2 J'r r'J of whole
chunks.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from upright.estimators.fit.result import inverse, with_known

Array = NDArray[np.float64]

SLIGHT = 0.5
"""A move of fewer standard deviations is negligible."""
STEPS = 4
"""Iterations of the active set per unknown: how often one of them may reach a bound or leave it."""
ROUNDING = 1e-9
"""Tolerance for rounding of an unknown that is held: in standard deviations for leaving its bound, and relative to its
reach."""


@dataclass(frozen=True, slots=True)
class Uncertainty:
    """Covariances (p, p) of the estimated parameters: `total`, and `alone`, from the data without any prior. `every`
    (n, n) is the total covariance of all unknowns."""

    total: Array
    alone: Array
    every: Array


class RecursiveGaussNewton:
    """The first `estimated` of the unknowns z (n,) are estimated parameters. All others, and those at the indices
    `nuisance`, are nuisance parameters, whose prior counts as data.

    `prior` (n,) is one over the variances of z. Besides z there are `own` unknowns of the current segment and `held`
    parameters that are neither estimated nor known exactly, both in units of their standard deviation. z stays within
    `lower` and `upper` (n,). `clustered`: residuals are correlated within a chunk.
    """

    def __init__(
        self,
        prior: Array,
        lower: Array,
        upper: Array,
        *,
        estimated: int,
        own: int = 0,
        held: int = 0,
        nuisance: Sequence[int] = (),
        clustered: bool = False,
    ) -> None:
        self._lower, self._upper = lower, upper
        self._estimated = estimated
        self._clustered = clustered
        self._size = size = len(prior)
        self._end = end = size + own
        self._own, self._held = slice(size, end), slice(end, end + held)
        self._others = np.r_[0:size, end : end + held]
        self._prior = np.diag(np.concatenate((prior, np.ones(own), np.zeros(held))))
        self._data = self._prior.copy()
        machine = [place for place in range(estimated) if place not in nuisance]
        self._data[machine, machine] = 0.0
        self._nuisance = [*nuisance, *range(estimated, size)]
        self._side = np.isin(np.arange(size), self._nuisance)

        self.z: Array = np.zeros(size)
        """The unknowns."""
        self.forget()

    def forget(self) -> None:
        """Forget all data, but keep z."""
        total = len(self._prior)
        self._information: Array = np.zeros((total, total))
        self._meat: Array = np.zeros((total, total))
        self._scores: Array = np.zeros((0, total))
        self._right: Array = np.zeros(total)

    def begin(self, prior: Array) -> None:
        """Begin a segment with the next chunk: the own unknowns of the last one are eliminated. `prior` (k,) is one
        over the variances of those of the next one."""
        own, others = self._own, self._others
        turn = np.zeros((len(others), len(self._right)))
        turn[:, others] = np.eye(len(others))
        inner = self._information[own, own] + self._prior[own, own]
        turn[:, own] = -np.linalg.solve(inner, self._information[own][:, others]).T
        information = turn @ self._information[:, others]
        meat = turn @ (self._meat if self._clustered else self._meat + self._own_prior()) @ turn.T
        scores = self._scores @ turn.T
        right = turn @ self._right
        self._information[:], self._meat[:], self._right[:] = 0.0, 0.0, 0.0
        self._information[np.ix_(others, others)] = information
        self._meat[np.ix_(others, others)] = meat
        self._right[others] = right
        self._scores = np.zeros((len(scores), len(self._right)))
        self._scores[:, others] = scores
        for each in (self._prior, self._data):
            each[own, own] = np.diag(prior)

    def add(self, residual: Array, columns: Array, kept: float) -> None:
        """Take a chunk: `residual` (m,), `columns` (m, n + own + held) derivatives of the prediction.

        `kept` is the factor on the weight of all previous chunks.
        """
        self._information *= kept
        self._right *= kept
        self._meat *= kept * kept
        added = columns.T @ columns
        self._information += added
        self._right += columns.T @ residual + added[:, : self._size] @ self.z
        if self._clustered:
            self._scores = _compressed(np.vstack((kept * self._scores, columns.T @ residual)))
        else:
            self._meat += added

    def move(self, about: Array, reach: Array) -> bool:
        """Move z to the solution, but not farther from `about` (n,) than `reach` (n,), nor beyond the bounds. Returns
        whether `reach` limited the move.

        The estimated parameters move along one direction, as far as all of them may. Nuisance parameters are limited
        one by one: the move of a noise with little effect must not shorten that of the parameters.
        """
        side = self._side
        lower = np.where(side, np.maximum(self._lower, about - reach), self._lower)
        upper = np.where(side, np.minimum(self._upper, about + reach), self._upper)
        away = self._solution(about, lower, upper) - about
        share = float(np.min(reach[~side] / np.maximum(np.abs(away[~side]), 1e-300), initial=1.0))
        self.z = np.clip(about + np.where(side, 1.0, share) * away, self._lower, self._upper)
        # An unknown that is held at its reach may differ from it by rounding, which must not decide.
        stopped = bool((np.abs(away[side]) >= (1.0 - ROUNDING) * reach[side]).any())
        return share < 1.0 or (stopped and self.side_deviations(about) > SLIGHT)

    def side_deviations(self, about: Array) -> float:
        """Distance of the nuisance parameters from `about` (n,), in standard deviations given all other unknowns."""
        moved = (self.z - about)[self._nuisance]
        places = np.ix_(self._nuisance, self._nuisance)
        information = self._information[places] + self._prior[places]
        return float(np.sqrt(moved @ information @ moved))

    def _solution(self, about: Array, lower: Array, upper: Array) -> Array:
        """The best solution z (n,) between `lower` and `upper` (n,), starting from `about` (n,).

        An unknown that reaches its bound is held there while the others move on, and is released if it would move back
        inside: the primal active set method (Nocedal and Wright, "Numerical optimization", 2nd ed., algorithm 16.3).
        """
        size, end = self._size, self._end
        information = self._information[:end, :end] + self._prior[:end, :end]
        right = self._right[:end]
        solution = np.asarray(np.linalg.solve(information, right), dtype=np.float64)
        if ((solution[:size] >= lower) & (solution[:size] <= upper)).all():
            return solution[:size]
        least, most = np.full(end, -np.inf), np.full(end, np.inf)
        least[:size], most[:size] = lower, upper
        at = np.concatenate((about, solution[size:]))
        free = np.ones(end, dtype=bool)
        for _ in range(STEPS * size):
            way = np.zeros(end)
            way[free] = np.linalg.solve(information[np.ix_(free, free)], (right - information @ at)[free])
            bound = np.where(way > 0.0, most, least) - at
            room = np.divide(bound, way, out=np.full(end, np.inf), where=np.abs(way) > 0.0)
            stop = int(np.argmin(room))
            if room[stop] < 1.0:
                at = at + max(room[stop], 0.0) * way
                at[stop], free[stop] = (most if way[stop] > 0.0 else least)[stop], False
                continue
            at = at + way
            pull = np.where(free, 0.0, right - information @ at)
            inward = np.where(at <= least, pull, np.where(at >= most, -pull, 0.0)) / np.sqrt(np.diag(information))
            back = int(np.argmax(inward))
            if inward[back] <= ROUNDING:
                break
            free[back] = True
        return at[:size]

    def uncertainty(self) -> Uncertainty:
        """The present covariances."""
        end, size = self._end, self._estimated
        meat = self._meat if self._clustered else self._meat + self._own_prior()
        information = self._information + self._data
        spread = inverse(information[:end, :end])
        data_meat = meat[:end, :end].copy()
        data_meat[self._nuisance, self._nuisance] += np.diag(self._prior)[self._nuisance]
        alone = self._sandwich(spread, data_meat)
        information = self._information[:end, :end] + self._prior[:end, :end]
        spread = inverse(information)
        meat = meat[:end, :end].copy()
        places = range(self._size)
        meat[places, places] += np.diag(self._prior)[: self._size]
        across = self._information[:end, self._held]
        total = with_known(self._sandwich(spread, meat), information, across, np.ones(across.shape[1]))
        return Uncertainty(total[:size, :size], alone[:size, :size], total[: self._size, : self._size])

    def _sandwich(self, spread: Array, meat: Array) -> Array:
        """spread (meat + scores' scores) spread, (n, n). The part of the scores stays a sum of squares after rounding:
        where the data hardly determine a direction, a product of three matrices gave negative variances."""
        seen = self._scores[:, : len(spread)] @ spread
        return np.asarray(spread @ meat @ spread + seen.T @ seen)

    def _own_prior(self) -> Array:
        """The prior of the segment's own unknowns alone, which is a measurement like any other, of its first sample."""
        prior = np.zeros_like(self._prior)
        prior[self._own, self._own] = self._prior[self._own, self._own]
        return prior


def _compressed(rows: Array) -> Array:
    """Rows (m, n) with the same product rows' rows, n of them at most."""
    return rows if len(rows) <= rows.shape[1] else np.asarray(np.linalg.qr(rows, mode="r"))
