"""Since when does which effect show? The generalised likelihood ratio of every effect at every onset.

Whitened innovations y are, for small changes, N t + C a + noise: nuisances t with their prior, and an effect's
amplitudes a, which act from an unknown second on. All that is needed of a second of data are the products of its
columns, so that they are gathered once and every onset is looked at without going through data again:

    with H = (N'N + prior)^-1 N'C(onset):   score s = C'y - H'N'y,   information F = C'C - H'N'C,
    size F^-1 s,   statistic T = s' F^-1 s, twice the rise of the log likelihood.

An effect sets in somewhere within a second, so what it does in that one is free: else its neighbours fit better.

Source: Willsky and Jones, "A generalized likelihood ratio approach to the detection and estimation of jumps in linear
systems", IEEE Transactions on Automatic Control 21 (1976) 108-112.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from diagnosis.products import Products

Array = NDArray[np.float64]

BEGINNING = 0
"""The onset of what was there from the beginning."""
LEAST = 1e-9
"""Share of its own information that an effect must keep beside the nuisances."""
WORTH_A_LOOK, NEAR = 12.0, 0.5
"""Statistic, and share of the best one, from which on an effect is looked at closely."""


@dataclass(frozen=True, slots=True)
class Amplitudes:
    """An effect's `columns` among all, with the bounds (k,) of its amplitudes; `anytime`: it may set in at any time."""

    name: str
    columns: tuple[int, ...]
    lower: tuple[float, ...]
    upper: tuple[float, ...]
    anytime: bool = True


@dataclass(frozen=True, slots=True)
class Onset:
    """An effect at its likeliest onset, a number of a second, `BEGINNING` for from the beginning.

    `statistic` has innovations that are not quite white taken into account by `inflation`. `sizes` and
    `standard_errors` (k,).
    """

    effect: Amplitudes
    second: int
    statistic: float
    inflation: float
    sizes: Array
    standard_errors: Array


def onsets(
    products: Products, effects: Sequence[Amplitudes], known: Sequence[Onset], shortest: int
) -> tuple[list[Onset], dict[str, float]]:
    """The effects that stand out, each at its likeliest onset, the strongest first, with the `known` taken for granted.

    Those that gain less than half as much as the strongest are left out. An onset is at least `shortest` seconds ago.
    With them, of every effect that can be told from the nuisances, the standard error of its first amplitude.
    """
    blocks, starts = products.latest()
    nuisances = len(products.prior)
    further = sum(len(each.effect.columns) * (1 + (each.second != BEGINNING)) for each in known)
    prior = np.concatenate((products.prior, np.zeros(further)))
    expected = prior * np.concatenate((products.mean, np.zeros(further)))
    blocks = _with_known(blocks, starts, nuisances, known)
    fitted = _Fitted.of(blocks, prior, expected)
    taken = {each.effect.name for each in known}
    # Window 0 is from the beginning on; of the second before another one it may have acted in a part.
    late = 1 + np.flatnonzero((np.diff(starts) == 1) & (starts[1:] <= products.seconds - shortest))
    windows = np.concatenate(([0], late))
    left = [effect for effect in effects if effect.name not in taken]
    best = [*_singles([each for each in left if len(each.columns) == 1], fitted, nuisances, windows)]
    for size in sorted({len(each.columns) for each in left} - {1}):
        best += _several([each for each in left if len(each.columns) == size], fitted, nuisances, windows)
    most = max((gain for _, _, gain in best), default=0.0)
    found = []
    for effect, window, gain in best:
        if gain > max(WORTH_A_LOOK, NEAR * most):
            where = [len(prior) + place - nuisances for place in effect.columns]
            onset = _examine(
                effect, blocks, prior, expected, where, window, BEGINNING if window == 0 else int(starts[window])
            )
            if onset is not None:
                found.append(onset)
    told = fitted.errors(np.array([effect.columns[0] - nuisances for effect in left], dtype=np.int64)).tolist()
    return (
        sorted(found, key=lambda each: -each.statistic),
        {effect.name: error for effect, error in zip(left, told, strict=True) if np.isfinite(error)},
    )


@dataclass(frozen=True, slots=True)
class _Fitted:
    """The nuisances fitted to all data, and what is left of all other columns from each second on.

    `own` (b, m, m) their products; `cross` (b, p, m) those with the nuisances, `turned` (b, p, m) the H; `information`
    (b, m) what is left of the diagonal, `score` (b, m).
    """

    own: Array
    cross: Array
    turned: Array
    information: Array
    score: Array

    @classmethod
    def of(cls, blocks: Array, prior: Array, expected: Array) -> _Fitted:
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
        """Standard errors of amplitudes that act from the beginning; infinite where nothing tells one."""
        left, own = self.information[0, places], self.own[0, places, places]
        told = left > LEAST * np.maximum(own, 1e-300)
        return np.where(told, 1.0 / np.sqrt(np.where(told, left, 1.0)), np.inf)


_Best = tuple[Amplitudes, int, float]
"""An effect, the window in which it gains most, and what it gains with the second before that free."""


def _singles(
    effects: Sequence[Amplitudes], fitted: _Fitted, nuisances: int, windows: NDArray[np.int64]
) -> Iterator[_Best]:
    """Effects of one amplitude, all at once.

    An effect sets in within a second: one amplitude holds from that second on, and a change of it from the next.
    """
    if not effects:
        return
    where = np.array([effect.columns[0] - nuisances for effect in effects])
    lower = np.array([effect.lower[0] for effect in effects])
    upper = np.array([effect.upper[0] for effect in effects])
    own = np.diagonal(fitted.own, axis1=1, axis2=2)[:, where]
    information, score = fitted.information[:, where], fitted.score[:, where]
    told = information > LEAST * np.maximum(own, 1e-300)
    gains = np.zeros((len(windows), len(where)))
    size = score[0] / np.where(told[0], information[0], 1.0)
    gains[0] = np.where(told[0] & (size >= lower) & (size <= upper), size * score[0], 0.0)
    after, part = windows[1:], windows[1:] - 1
    if len(after):
        both = own[after] - np.einsum("bpm,bpm->bm", fitted.cross[part][:, :, where], fitted.turned[after][:, :, where])
        determinant = information[part] * information[after] - both * both
        clear = told[part] & told[after] & (determinant > LEAST * information[part] * information[after])
        safe = np.where(clear, determinant, 1.0)
        early = (information[after] * score[part] - both * score[after]) / safe
        change = (information[part] * score[after] - both * score[part]) / safe
        size = early + change
        inside = clear & (size >= lower) & (size <= upper) & np.array([effect.anytime for effect in effects])
        gains[1:] = np.where(inside, early * score[part] + change * score[after] - _price(windows), 0.0)
    chosen = np.argmax(gains, axis=0)
    for column, (effect, place) in enumerate(zip(effects, chosen.tolist(), strict=True)):
        yield effect, int(windows[place]), float(gains[place, column])


def _several(
    effects: Sequence[Amplitudes], fitted: _Fitted, nuisances: int, windows: NDArray[np.int64]
) -> Iterator[_Best]:
    """Effects of equally many amplitudes, all at once; whether their signs can be is looked at later."""
    where = np.array([effect.columns for effect in effects]) - nuisances
    count, size = where.shape
    cross, turned = fitted.cross[:, :, where], fitted.turned[:, :, where]
    own = fitted.own[:, where[:, :, None], where[:, None, :]]
    score = fitted.score[:, where]
    after, part = windows[1:], windows[1:] - 1

    def left(one: NDArray[np.int64], other: NDArray[np.int64]) -> Array:
        return np.asarray(own[other] - np.einsum("wpek,wpel->wekl", cross[one], turned[other]))

    gains = np.zeros((len(windows), count))
    gains[:1] = _gain(left(windows[:1], windows[:1]), score[:1])
    if len(after):
        square = np.empty((len(after), count, 2 * size, 2 * size))
        square[..., :size, :size], square[..., size:, size:] = left(part, part), left(after, after)
        square[..., :size, size:] = both = left(part, after)
        square[..., size:, :size] = np.swapaxes(both, -1, -2)
        late = _gain(square, np.concatenate((score[part], score[after]), axis=-1)) - _price(windows)
        gains[1:] = np.where([effect.anytime for effect in effects], late, 0.0)
    chosen = np.argmax(gains, axis=0)
    for column, (effect, place) in enumerate(zip(effects, chosen.tolist(), strict=True)):
        yield effect, int(windows[place]), float(gains[place, column])


def _gain(information: Array, score: Array) -> Array:
    """What sizes (..., k) without bounds gain, (...)."""
    scale = np.sqrt(np.maximum(np.diagonal(information, axis1=-2, axis2=-1), 1e-300))
    unit = information / (scale[..., :, None] * scale[..., None, :]) + 1e-9 * np.eye(scale.shape[-1])
    scaled = score / scale
    return np.asarray(np.sum(np.linalg.solve(unit, scaled[..., None])[..., 0] * scaled, axis=-1))


def _price(windows: NDArray[np.int64]) -> float:
    """Of an onset that had to be found, and of what the second before it is free to be."""
    return 2.0 * float(np.log(len(windows))) + 1.0


def _examine(
    effect: Amplitudes,
    blocks: Array,
    prior: Array,
    expected: Array,
    where: Sequence[int],
    window: int,
    second: int,
) -> Onset | None:
    """The effect from `window` on. What it may have done in the second before is one more nuisance."""
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
    """The sizes (k,) within the bounds that gain most: the best over all sets of which the others are zero."""
    width = len(score)
    best, most = np.zeros(width), 0.0
    for chosen in range(2**width - 1, 0, -1):
        where = [place for place in range(width) if chosen >> place & 1]
        sizes = _inverse(information[np.ix_(where, where)]) @ score[where]
        inside = all(effect.lower[p] <= size <= effect.upper[p] for p, size in zip(where, sizes, strict=True))
        gained = float(sizes @ score[where])
        if inside and gained > most:
            most = gained
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
    """By how much scores scatter more from second to second than their information says, at least 1.

    From what is left of the innovations when the effect itself is taken out, with the nuisances `base` fitted again.
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
    """Of a positive definite matrix (k, k) in whatever units; zero where nothing is known at all."""
    known = np.diag(square) > 1e-100
    scale = np.where(known, 1.0 / np.sqrt(np.where(known, np.diag(square), 1.0)), 0.0)
    unit = square * scale[:, None] * scale + 1e-12 * np.eye(len(square))
    return np.asarray(np.linalg.inv(unit) * scale[:, None] * scale)


def _with_known(blocks: Array, starts: NDArray[np.int64], nuisances: int, known: Sequence[Onset]) -> Array:
    """`blocks` with the columns of what is known, from its onset on and in the second before, among the nuisances."""
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
