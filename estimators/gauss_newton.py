"""Nonlinear least squares with parameters that all data share and others that one stretch alone has.

Every stretch of data has its own initial state, so the normal equations have an arrow's shape: each stretch's own
unknowns are eliminated before the common ones are solved for, and a fit over forty windows costs hardly more than over
one. Levenberg-Marquardt steps with Nielsen's damping, bounds by an active set. Source: Madsen, Nielsen and Tingleff,
"Methods for non-linear least squares problems" (2004), algorithm 3.16; Schur complement as in bundle adjustment.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

LONGEST_STEP = 2.0
"""Typical sizes by which a parameter moves at most in one step."""


@dataclass(frozen=True, slots=True)
class Block:
    """One stretch: residuals (m,), their derivatives by the common parameters (m, p) and by its own (m, q)."""

    residual: Array
    common: Array
    own: Array


Evaluate = Callable[[Array, Sequence[Array]], list[Block] | None]
"""Of common parameters and own parameters by stretch; None where there is no finite value."""


@dataclass(frozen=True, slots=True)
class Minimum:
    """Where it ended. `information` (p, p) is J'J of the common parameters with the own ones eliminated."""

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
    watched: int | None = None,
) -> Minimum | None:
    """The least half sum of squares from `common` (p,) and `own` on; `scale` (p,) are typical sizes of the first.

    It is converged when no step moves one of the first `watched` parameters (all by default) by more than `tolerance`
    of its scale, or the cost is not expected to fall by more than `enough`: with residuals of unit variance a fall of x
    moves no parameter by more than sqrt(2 x) standard deviations. None where the start itself has no finite value.
    """
    common = np.clip(common, lower, upper)
    own = [part.copy() for part in own]
    blocks = evaluate(common, own)
    if blocks is None:
        return None
    cost = _cost(blocks)
    damping, growth = 1e-4, 2.0
    done = False
    taken = 0
    information, gradient, _, _ = _reduce(blocks, scale, 0.0)
    while taken < iterations and not done:
        taken += 1
        free = ~(((common <= lower) & (gradient > 0.0)) | ((common >= upper) & (gradient < 0.0)))
        if not free.any() and not any(len(part) for part in own):
            done = True
            break
        reduced, slope, reserve, parts = _reduce(blocks, scale, damping)
        step = np.zeros_like(common)
        fall = reserve
        if free.any():
            system = reduced[np.ix_(free, free)]
            fall += 0.5 * float(slope[free] @ np.linalg.lstsq(system, slope[free], rcond=None)[0])
            system += damping * np.diag(np.diag(information)[free] + 1e-12)
            step[free] = -np.linalg.lstsq(system, slope[free], rcond=None)[0]
        if fall <= enough:
            done = True
            break
        step *= min(1.0, LONGEST_STEP / max(float(np.max(np.abs(step), initial=0.0)), 1e-300))
        trial = np.clip(common + scale * step, lower, upper)
        step = (trial - common) / scale
        moves = [-(gain @ step + offset) for gain, offset in parts]
        trial_own = [part + move for part, move in zip(own, moves, strict=True)]
        expected = -float(slope @ step) - 0.5 * float(step @ reduced @ step) + reserve
        trial_blocks = evaluate(trial, trial_own)
        trial_cost = _cost(trial_blocks) if trial_blocks is not None else np.inf
        small = float(np.max(np.abs(step[:watched]), initial=0.0)) < tolerance
        if trial_blocks is not None and trial_cost <= cost:
            gained = cost - trial_cost
            blocks, common, own = trial_blocks, trial, trial_own
            done = small
            cost = trial_cost
            ratio = gained / max(expected, 1e-300)
            damping = max(damping * max(1.0 / 3.0, 1.0 - (2.0 * ratio - 1.0) ** 3), 1e-12)
            growth = 2.0
            information, gradient, _, _ = _reduce(blocks, scale, 0.0)
        else:
            done = small
            damping *= growth
            growth *= 2.0
            if damping > 1e14:
                break
    information, _, _, _ = _reduce(blocks, scale, 0.0)
    outer = np.outer(scale, scale)
    return Minimum(
        common=common,
        own=tuple(own),
        cost=cost,
        blocks=tuple(blocks),
        information=information / outer,
        iterations=taken,
        converged=done,
        at_bound=(common <= lower) | (common >= upper),
    )


def eliminate(block: Block) -> tuple[Array, Array]:
    """Residual and common derivatives of `block` with all that its own parameters explain taken out."""
    if block.own.shape[1] == 0:
        return block.residual, block.common
    basis, _ = np.linalg.qr(block.own)
    return block.residual - basis @ (basis.T @ block.residual), block.common - basis @ (basis.T @ block.common)


def _cost(blocks: Sequence[Block]) -> float:
    return 0.5 * sum(float(block.residual @ block.residual) for block in blocks)


def _reduce(
    blocks: Sequence[Block], scale: Array, damping: float
) -> tuple[Array, Array, float, list[tuple[Array, Array]]]:
    """Scaled normal equations of the common parameters, by how much the cost falls with the own parameters alone, and
    how each block's own follow from a common step."""
    size = len(scale)
    matrix, vector, reserve = np.zeros((size, size)), np.zeros(size), 0.0
    parts: list[tuple[Array, Array]] = []
    for block in blocks:
        common = block.common * scale
        matrix += common.T @ common
        vector += common.T @ block.residual
        if block.own.shape[1] == 0:
            parts.append((np.zeros((0, size)), np.zeros(0)))
            continue
        square = block.own.T @ block.own
        square += np.diag((damping + 1e-12) * np.diag(square) + 1e-300)
        across = block.own.T @ common
        gain: Array = np.linalg.solve(square, across).astype(np.float64)
        offset: Array = np.linalg.solve(square, block.own.T @ block.residual).astype(np.float64)
        matrix -= across.T @ gain
        vector -= across.T @ offset
        reserve += 0.5 * float(block.residual @ block.own @ offset)
        parts.append((gain, offset))
    return matrix, vector, reserve, parts
