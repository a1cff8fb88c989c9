"""Which effect shows, and since when? The generalised likelihood ratio of every effect at every onset.

Whitened innovations y are, for small changes, N t + C a + noise: nuisances t with their prior, and an effect's
amplitudes a, which act from an unknown second on. Only the products of the columns of a second of data are needed. So
they are gathered once, and every onset is evaluated without processing the data again:

    with H = (N'N + prior)^-1 N'C(onset):   score s = C'y - H'N'y,   information F = C'C - H'N'C,
    amplitude F^-1 s,   statistic T = s' F^-1 s, twice the rise of the log-likelihood.

An effect sets in somewhere within a second, so its amplitudes in that second are free: otherwise its neighbours fit
better.

Source: Willsky and Jones, "A generalized likelihood ratio approach to the detection and estimation of jumps in linear
systems", IEEE Transactions on Automatic Control 21 (1976) 108-112.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

BEGINNING = 0
"""The onset of an effect that was there from the beginning."""
LEAST = 1e-9
"""Share of its own information that an effect must keep when the nuisances are projected out."""


@dataclass(frozen=True, slots=True)
class Amplitudes:
    """An effect's `columns` among all, with the bounds (k,) of its amplitudes; `anytime`: it may set in at any time;
    `formula_error` as of an effect (models.effect)."""

    name: str
    columns: tuple[int, ...]
    lower: tuple[float, ...]
    upper: tuple[float, ...]
    anytime: bool = True
    formula_error: float = 0.0


@dataclass(frozen=True, slots=True)
class Onset:
    """An effect at its most likely onset, the number of a second, or `BEGINNING` if it was there from the beginning.

    `statistic` is corrected by `inflation` for innovations that are not quite white. `sizes` and `standard_errors` (k,)
    of the amplitudes.
    """

    effect: Amplitudes
    second: int
    statistic: float
    inflation: float
    sizes: Array
    standard_errors: Array


@dataclass(frozen=True, slots=True)
class Fitted:
    """The nuisances fitted to all data, and what is left of all other columns from each second on.

    `own` (b, m, m): their products. `cross` (b, p, m): products with the nuisances. `turned` (b, p, m): the H.
    `information` (b, m): what is left of the diagonal. `score` (b, m).
    """

    own: Array
    cross: Array
    turned: Array
    information: Array
    score: Array

    @classmethod
    def of(cls, blocks: Array, prior: Array, expected: Array) -> Fitted:
        count = len(prior)
        sums = np.empty_like(blocks)
        sums[-1] = blocks[-1]
        for part in range(len(blocks) - 2, -1, -1):  # a third of the time of a cumulative sum over the first axis
            np.add(sums[part + 1], blocks[part], out=sums[part])
        inverse = _inverse(sums[0, :count, :count] + np.diag(prior))
        cross = sums[:, :count, count:-1]
        turned = inverse @ cross
        own = sums[:, count:-1, count:-1]
        information = np.diagonal(own, axis1=1, axis2=2) - np.einsum("bpm,bpm->bm", cross, turned)
        score = sums[:, count:-1, -1] - np.einsum("bpm,p->bm", cross, inverse @ (sums[0, :count, -1] + expected))
        return cls(own, cross, turned, information, score)

    def errors(self, places: NDArray[np.int64]) -> Array:
        """Standard errors of amplitudes that act from the beginning; infinite if one is not identifiable."""
        left, own = self.information[0, places], self.own[0, places, places]
        identifiable = left > LEAST * np.maximum(own, 1e-300)
        return np.where(identifiable, 1.0 / np.sqrt(np.where(identifiable, left, 1.0)), np.inf)


def examine(
    effect: Amplitudes,
    blocks: Array,
    prior: Array,
    expected: Array,
    where: Sequence[int],
    window: int,
    second: int,
) -> Onset | None:
    """The effect from `window` on. Its amplitudes in the second before are further nuisances."""
    count = len(prior)
    total = blocks.sum(axis=0)
    late = blocks[window:].sum(axis=0)
    part = blocks[window - 1] if window else np.zeros_like(late)
    free = list(where) if window else []
    inner = np.block([
        [total[:count, :count] + np.diag(prior), part[:count, free]],
        [part[free, :count], part[np.ix_(free, free)]],
    ])  # fmt: skip
    inverse = _inverse(inner)
    cross = np.concatenate((late[:count, where], np.zeros((len(free), len(where)))))
    turned = inverse @ cross
    own = late[np.ix_(where, where)]
    information = own - cross.T @ turned
    if not (np.diag(information) > LEAST * np.maximum(np.diag(own), 1e-300)).all():
        return None
    base = inverse @ np.concatenate((total[:count, -1] + expected, part[free, -1]))
    sizes = _allowed(effect, information, late[where, -1] - cross.T @ base)
    fitted = base - turned @ sizes
    inflation = _inflation(blocks, window, where, free, sizes, information, turned, fitted)
    errors = np.sqrt(inflation * np.diag(_inverse(information)))
    return Onset(effect, second, float(sizes @ information @ sizes) / inflation, inflation, sizes, errors)


def _allowed(effect: Amplitudes, information: Array, score: Array) -> Array:
    """The amplitudes (k,) within the bounds that raise the likelihood most: the best subset, the others zero."""
    width = len(score)
    best, most = np.zeros(width), 0.0
    for chosen in range(2**width - 1, 0, -1):
        where = [place for place in range(width) if chosen >> place & 1]
        sizes = _inverse(information[np.ix_(where, where)]) @ score[where]
        inside = all(effect.lower[p] <= size <= effect.upper[p] for p, size in zip(where, sizes, strict=True))
        statistic = float(sizes @ score[where])
        if inside and statistic > most:
            most = statistic
            best = np.zeros(width)
            best[where] = sizes
            if len(where) == width:
                break
    return best


def _inflation(
    blocks: Array,
    window: int,
    where: Sequence[int],
    free: Sequence[int],
    sizes: Array,
    information: Array,
    turned: Array,
    base: Array,
) -> float:
    """Variance inflation, at least 1: by how much scores scatter more from second to second than by their information.

    It is computed from the innovations without the effect itself, with the nuisances `base` fitted again.
    """
    count = len(base) - len(free)
    acts = (np.arange(len(blocks)) >= window).astype(np.float64)[:, None]
    others = (
        blocks[:, :count, -1] - blocks[:, :count, :count] @ base[:count] - acts * (blocks[:, :count, where] @ sizes)
    )
    rows = blocks[:, where]
    itself = rows[:, :, -1] - rows[:, :, :count] @ base[:count] - acts * (rows[:, :, where] @ sizes)
    if free and window > 0:
        early = blocks[window - 1]
        others[window - 1] -= early[:count, free] @ base[count:]
        itself[window - 1] -= early[np.ix_(free, free)] @ base[count:]
    scores = acts * itself - others @ turned[:count]
    if free and window > 0:
        scores[window - 1] -= itself[window - 1] @ turned[count:]
    meat = scores.T @ scores
    return max(1.0, float(np.trace(np.linalg.solve(information, meat))) / len(where))


def _inverse(square: Array) -> Array:
    """Inverse of a positive definite matrix (k, k) in any units; zero where nothing is known at all."""
    known = np.diag(square) > 1e-100
    scale = np.where(known, 1.0 / np.sqrt(np.where(known, np.diag(square), 1.0)), 0.0)
    unit = square * scale[:, None] * scale + 1e-12 * np.eye(len(square))
    return np.asarray(np.linalg.inv(unit) * scale[:, None] * scale)


def with_known(blocks: Array, starts: NDArray[np.int64], nuisances: int, known: Sequence[Onset]) -> Array:
    """`blocks` with the columns of known effects, from their onset on and in the second before, among the nuisances."""
    if not known:
        return blocks
    picks: list[int] = []
    masks: list[Array] = []
    for each in known:
        if each.second == BEGINNING:
            active = [np.ones(len(blocks))]
        else:
            active = [(starts >= each.second).astype(np.float64), (starts == each.second - 1).astype(np.float64)]
        for mask in active:
            picks += each.effect.columns
            masks += [mask] * len(each.effect.columns)
    width = blocks.shape[1]
    order = np.array([*range(nuisances), *picks, *range(nuisances, width)])
    mask = np.ones((len(blocks), len(order)))
    mask[:, nuisances : nuisances + len(picks)] = np.array(masks).T
    return np.asarray(blocks[:, order][:, :, order] * mask[:, :, None] * mask[:, None, :])
