"""Nonlinear least squares with common parameters and with parameters of a single segment.

Every segment of data has its own initial state, so the normal equations have arrowhead structure: the own unknowns of
each segment are eliminated before the common ones are solved for, and a fit over forty windows costs hardly more than
over one. Levenberg-Marquardt steps in a box that grows with success; bounds by an active set. If residuals remain
large, the curvature that Gauss-Newton neglects is estimated from step to step (symmetric rank one), and used as long as
it predicts the cost better than Gauss-Newton alone.
Sources: Madsen, Nielsen and Tingleff, "Methods for non-linear least squares problems" (2004); Dennis, Gay and Welsch,
"An adaptive nonlinear least-squares algorithm", ACM Transactions on Mathematical Software 7 (1981) 348-368; Nocedal and
Wright, "Numerical optimization", 2nd ed., sections 3.4, 6.2 and 10.3; Schur complement as in bundle adjustment.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

LONGEST_STEP = 2.0
"""Longest first step of a parameter, in typical magnitudes; it doubles after each step that went as predicted."""
LEAST_DAMPING, FIRST_DAMPING, STIFFER = 1e-7, 1e-3, 10.0
"""Share of the diagonal that is added to it: minimum, value after a step too far, and factor from step to step."""
SHORTENED = 2
"""Consecutive rejections up to which a step is only shortened: damping would turn it out of a narrow curved valley."""
PATIENCE = 12
"""Steps, accepted or rejected, over which the cost has to fall by `enough` per step: at a kink, where a delay meets a
sample, no step does what is predicted."""
ROUNDING = 1e-10
"""Share of the largest eigenvalue of the normal equations, with each unknown in its own unit, below which an eigenvalue
is rounding error."""
SILENT = 1e-7
"""An unknown has no effect on the data if its effect, per typical magnitude, is below this share of the largest."""
LAST_DAMPING = 1e-4
"""Least damping of the last step, whose cost is not checked: in directions without information it must not go far."""


@dataclass(frozen=True, slots=True)
class Block:
    """One segment: residuals (m,), their derivatives with respect to the common parameters (m, p) and its own
    (m, q)."""

    residual: Array
    common: Array
    own: Array


@dataclass(frozen=True, slots=True)
class Normal:
    """One segment's share of the normal equations: J'J (p + k, p + k) and J'r (p + k,), its own k unknowns last."""

    matrix: Array
    vector: Array


@dataclass(frozen=True, slots=True)
class Expansion:
    """The cost at a point and its quadratic expansion there, by segment."""

    cost: float
    normals: tuple[Normal, ...]


@dataclass(frozen=True, slots=True)
class _Stacked(Expansion):
    blocks: tuple[Block, ...]


Evaluate = Callable[[Array, Sequence[Array]], list[Block] | None]
"""Function of the common parameters and of the own parameters by segment; None if there is no finite value."""
E = TypeVar("E", bound=Expansion)


@dataclass(frozen=True, slots=True)
class Minimum:
    """The result of a descent. `information` (p, p) is J'J of the common parameters with the own ones eliminated.

    Only `minimise` sets `blocks`.
    """

    common: Array
    own: tuple[Array, ...]
    cost: float
    blocks: tuple[Block, ...]
    information: Array
    iterations: int
    converged: bool
    at_bound: NDArray[np.bool_]


def minimise(
    evaluate: Evaluate,
    common: Array,
    own: Sequence[Array],
    *,
    scale: Array,
    lower: Array,
    upper: Array,
    iterations: int = 50,
    tolerance: float = 1e-6,
    enough: float = 1e-6,
) -> Minimum | None:
    """Minimises half the sum of squares. Arguments and result as for `descend`."""

    def expand(common: Array, own: Sequence[Array]) -> _Stacked | None:
        blocks = evaluate(common, own)
        if blocks is None:
            return None
        cost = 0.5 * sum(float(block.residual @ block.residual) for block in blocks)
        return _Stacked(cost, tuple(map(_normal, blocks)), tuple(blocks))

    found = descend(
        expand,
        common,
        own,
        scale=scale,
        lower=lower,
        upper=upper,
        iterations=iterations,
        tolerance=tolerance,
        enough=enough,
    )
    return found and replace(found[0], blocks=found[1].blocks)


def descend(
    expand: Callable[[Array, Sequence[Array]], E | None],
    common: Array,
    own: Sequence[Array],
    *,
    scale: Array,
    lower: Array,
    upper: Array,
    iterations: int,
    tolerance: float,
    enough: float,
    watched: int | None = None,
    is_finite: Callable[[Array, Sequence[Array]], bool] | None = None,
) -> tuple[Minimum, E] | None:
    """Minimises the cost from `common` (p,) and `own`; returns the minimum and the expansion there. `scale` (p,) are
    typical magnitudes of `common`.

    The descent has converged if no step moves one of the first `watched` parameters (all by default) by more than
    `tolerance` of its scale, or if the cost is not expected to fall by more than `enough`: with residuals of unit
    variance a fall of x moves no parameter by more than sqrt(2 x) standard deviations. The last step is still made,
    unless its end has no finite cost, which `is_finite` says without an expansion; the result's expansion is that at
    its beginning. None if the start itself has no finite cost.
    """
    common = np.clip(common, lower, upper)
    own = [part.copy() for part in own]
    here = expand(common, own)
    if here is None:
        return None
    missing, augmented = np.zeros((len(common), len(common))), False
    costs = [here.cost]
    damping, reach = LEAST_DAMPING, LONGEST_STEP
    done = False
    taken = rejected = 0
    information, gradient, _, _ = _reduce(here, scale, 0.0)
    while taken < iterations and not done:
        taken += 1
        if len(costs) > PATIENCE and costs[-1 - PATIENCE] - costs[-1] <= PATIENCE * enough:
            done = True
            break
        free = ~(((common <= lower) & (gradient > 0.0)) | ((common >= upper) & (gradient < 0.0)))
        if not free.any() and not any(len(part) for part in own):
            done = True
            break
        reduced, slope, reserve, parts = _reduce(here, scale, damping)
        some = np.ix_(free, free)
        curvature = reduced + _positive(information, missing, free) if augmented else reduced
        fall = reserve + 0.5 * float(slope[free] @ _solved(curvature[some], slope[free]))
        done = fall <= enough
        stiffer = (max(damping, LAST_DAMPING) if done else damping) * np.diag(np.diag(information) + 1e-12)
        step = _step(curvature + stiffer, slope, free, (lower - common) / scale, (upper - common) / scale, reach)
        trial = np.clip(common + scale * step, lower, upper)
        step = (trial - common) / scale
        moves = [-(gain @ step + offset) for gain, offset in parts]
        trial_own = [part + move for part, move in zip(own, moves, strict=True)]
        if done:
            if is_finite(trial, trial_own) if is_finite else expand(trial, trial_own) is not None:
                common, own = trial, trial_own
            break
        linear, plain, more = (float(each) for each in (slope @ step, step @ reduced @ step, step @ missing @ step))
        predicted = reserve - linear - 0.5 * float(step @ curvature @ step)
        there = expand(trial, trial_own)
        if there is not None:
            off = here.cost - there.cost - (reserve - linear - 0.5 * plain)
            augmented = abs(off + 0.5 * more) < abs(off)
        # If no common parameter is free, only the predicted fall shows whether the own ones have converged.
        done = bool(free.any()) and float(np.max(np.abs(step[:watched]), initial=0.0)) < tolerance
        if there is None or there.cost > here.cost:
            rejected += 1
            if rejected > SHORTENED:
                damping = max(STIFFER * damping, FIRST_DAMPING)
            reach = 0.5 * float(np.max(np.abs(step), initial=0.0))
            if damping > 1e14:
                break
            costs.append(here.cost)
            continue
        rejected = 0
        ratio = (here.cost - there.cost) / max(predicted, 1e-300)
        if ratio > 0.75:
            damping, reach = max(damping / STIFFER, LEAST_DAMPING), 2.0 * reach
        elif ratio < 0.25:
            reach = 0.5 * float(np.max(np.abs(step), initial=0.0))
        here, common, own = there, trial, trial_own
        costs.append(here.cost)
        before = gradient
        information, gradient, _, _ = _reduce(here, scale, 0.0)
        missing = _updated(missing, step, gradient - before - information @ step)
    minimum = Minimum(
        common=common,
        own=tuple(own),
        cost=here.cost,
        blocks=(),
        information=information / np.outer(scale, scale),
        iterations=taken,
        converged=done,
        at_bound=(common <= lower) | (common >= upper),
    )
    return minimum, here


def eliminate(block: Block) -> tuple[Array, Array]:
    """Residual and common derivatives of `block`, with everything that its own parameters explain projected out."""
    if block.own.shape[1] == 0:
        return block.residual, block.common
    basis, _ = np.linalg.qr(block.own)
    return block.residual - basis @ (basis.T @ block.residual), block.common - basis @ (basis.T @ block.common)


def common_information(normals: Sequence[Normal], common: int) -> Array:
    """J'J (p, p) of the first `common` = p unknowns with the others eliminated."""
    matrix, _, _, _ = _reduce(Expansion(0.0, tuple(normals)), np.ones(common), 0.0)
    return matrix


def _normal(block: Block) -> Normal:
    columns = np.concatenate((block.common, block.own), axis=1)
    return Normal(columns.T @ columns, columns.T @ block.residual)


def _solved(matrix: Array, vector: Array) -> Array:
    """The solution without the directions that the data do not determine. The matrix is positive definite but for
    rounding, so that half the product of the solution with `vector` is a fall of the cost, never a rise."""
    if not len(vector):
        return vector
    size = np.sqrt(np.maximum(np.diag(matrix), 0.0))
    size = np.where(size > SILENT * np.max(size), size, np.inf)
    squares, turned = np.linalg.eigh(matrix / np.outer(size, size))
    determined = squares > ROUNDING * squares[-1]
    along = (turned.T @ (vector / size))[determined] / squares[determined]
    return np.asarray(turned[:, determined] @ along / size)


def _step(curvature: Array, slope: Array, free: NDArray[np.bool_], lower: Array, upper: Array, reach: float) -> Array:
    """The step of the `free` unknowns, none longer than `reach`. An unknown that would exceed its bound stops there,
    and the others are solved for again: along a valley, half of a joint step leads uphill."""
    step = np.zeros(len(slope))
    free = free.copy()
    while free.any():
        some = np.ix_(free, free)
        step[free] = -_solved(curvature[some], slope[free] + curvature[np.ix_(free, ~free)] @ step[~free])
        step[free] *= min(1.0, reach / max(float(np.max(np.abs(step[free]))), 1e-300))
        beyond = free & ((step < lower) | (step > upper))
        if not beyond.any():
            break
        step[beyond] = np.clip(step[beyond], lower[beyond], upper[beyond])
        free &= ~beyond
    return step


def _positive(information: Array, missing: Array, free: NDArray[np.bool_]) -> Array:
    """`missing` curvature of the `free` unknowns on which the data depend, corrected so that the sum with `information`
    is positive definite in them.

    Each unknown is in the unit in which its information is 1. An eigenvalue below zero counts by its magnitude (Nocedal
    and Wright, section 3.4): along its direction a step is as short as the curvature is strong.
    """
    corrected = np.zeros_like(missing)
    size = np.sqrt(np.maximum(np.diag(information), 0.0))
    some = np.flatnonzero(free & (size > SILENT * float(np.max(size, initial=0.0))))
    rows, columns = np.ix_(some, some)
    unit = np.outer(size[some], size[some])
    with np.errstate(over="ignore", invalid="ignore"):
        both = (information[rows, columns] + missing[rows, columns]) / unit
    if not np.all(np.isfinite(both)):
        return corrected
    values, directions = np.linalg.eigh(both)
    floor = ROUNDING * float(np.max(np.abs(values), initial=0.0))
    more = np.where(values > 0.0, 0.0, np.maximum(np.abs(values), floor) - values)
    corrected[rows, columns] = missing[rows, columns] + (directions * more) @ directions.T * unit
    return corrected


def _updated(missing: Array, step: Array, unexplained: Array) -> Array:
    """`missing` curvature, updated to explain the change of the gradient over the last `step` that J'J leaves
    `unexplained` (symmetric rank one).

    It is scaled down first if it was too large (Dennis, Gay and Welsch).
    """
    known = float(step @ missing @ step)
    if known != 0.0:
        missing = min(1.0, abs(float(step @ unexplained) / known)) * missing
    rest = unexplained - missing @ step
    along = float(rest @ step)
    if abs(along) <= 1e-6 * float(np.linalg.norm(rest) * np.linalg.norm(step)):
        return missing
    return np.asarray(missing + np.outer(rest, rest) / along)


def _reduce(
    expansion: Expansion, scale: Array, damping: float
) -> tuple[Array, Array, float, list[tuple[Array, Array]]]:
    """Scaled normal equations of the common parameters, the fall of the cost by the own parameters alone, and, for each
    segment, the linear map from a common step to the step of its own parameters."""
    size = len(scale)
    matrix, vector, reserve = np.zeros((size, size)), np.zeros(size), 0.0
    parts: list[tuple[Array, Array]] = []
    for normal in expansion.normals:
        matrix += scale[:, None] * normal.matrix[:size, :size] * scale
        vector += scale * normal.vector[:size]
        if len(normal.vector) == size:
            parts.append((np.zeros((0, size)), np.zeros(0)))
            continue
        square = normal.matrix[size:, size:]
        square = square + np.diag((damping + 1e-12) * np.diag(square) + 1e-300)
        across, pull = normal.matrix[size:, :size] * scale, normal.vector[size:]
        solved = np.linalg.solve(square, np.concatenate((across, pull[:, None]), axis=1)).astype(np.float64)
        gain, offset = solved[:, :-1], solved[:, -1]
        matrix -= across.T @ gain
        vector -= across.T @ offset
        reserve += 0.5 * float(pull @ offset)
        parts.append((gain, offset))
    return matrix, vector, reserve, parts
