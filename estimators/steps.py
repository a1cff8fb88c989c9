"""Steps in the mean of a short series of estimates whose standard deviations are known, as a parameter of one vehicle
over its recordings.

    value_i = mean(part of i) + scatter + error_i,    var(error_i) = std_i^2, var(scatter) = tau^2

Estimates of one parameter scatter more than their standard deviations say, since no model is exact and no two
recordings are alike. For each place of a step, tau is estimated beside the two means: their weighted sum of squares
equals its degrees of freedom (Paule and Mandel, J. Res. NBS 87, 1982). The step then has a t-statistic (Knapp and
Hartung, Statistics in Medicine 22, 2003) with Satterthwaite's degrees of freedom, which are few if few estimates are
precise. The likeliest place is the one with the least p-value, multiplied by the number of places (Worsley, JASA 74,
1979). Steps are looked for in the whole series and in overlapping halves, quarters, ... of it, since a step that is
taken back later is none of the whole (seeded binary segmentation: Kovacs et al., Biometrika 110, 2023). A series with a
step is divided there, and each side is tested again.

At least two estimates are on each side: a single one that differs is as well an outlier.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike, NDArray

from upright.estimators.tails import t_sf

Array = NDArray[np.float64]

SIDE = 2
"""Minimum number of estimates before a step and after it."""
SHORTEST = 2 * SIDE
"""Estimates of the shortest series that can be tested."""
BLOCK = 1_000_000
"""Numbers in an array of places and estimates: about 8 MB."""
ITERATIONS, PRECISION = 50, 1e-9
"""Of the estimate of tau^2. Newton's method converges from below, since the sum of squares is convex in it."""


@dataclass(frozen=True, slots=True)
class Step:
    """The mean changes from `before` to `after`, each with its standard deviation, at estimate number `place`, the
    first after the step. `p_value` is corrected for all places, and for the `tests` of `steps`."""

    place: int
    before: tuple[float, float]
    after: tuple[float, float]
    p_value: float


def steps(values: ArrayLike, stds: ArrayLike, *, level: float, tests: int = 1) -> tuple[Step, ...]:
    """The steps in a series of `values`, (n,) in their order, with standard deviations `stds`, (n,) positive, that are
    significant at `level` with `tests` series tested; none in a series shorter than SHORTEST."""
    value, std = np.asarray(values, dtype=np.float64), np.asarray(stds, dtype=np.float64)
    divided = sorted(_divided(value, std, level / tests, 0))
    if not divided:
        return ()
    edges = [0, *(place for place, _ in divided), len(value)]
    order = np.arange(len(value))
    parts = np.array([(begin <= order) & (order < end) for begin, end in pairwise(edges)])
    found = _means(value, std, parts)
    levels = list(zip(found.mean.tolist(), np.sqrt(found.variance).tolist(), strict=True))
    return tuple(
        Step(place, before, after, min(1.0, p_value * tests))
        for (place, p_value), (before, after) in zip(divided, pairwise(levels), strict=True)
    )


def _divided(value: Array, std: Array, level: float, begin: int) -> Iterator[tuple[int, float]]:
    """Place and p-value of each step in a part of the series that begins at `begin`."""
    if len(value) < SHORTEST:
        return
    place, p_value = likeliest(value, std)
    if p_value > level:
        return
    yield begin + place, p_value
    yield from _divided(value[:place], std[:place], level, begin)
    yield from _divided(value[place:], std[place:], level, begin + place)


def likeliest(value: Array, std: Array) -> tuple[int, float]:
    """The place of the likeliest step in a series of at least SHORTEST estimates, and its p-value, corrected for all
    places in all intervals."""
    tested: list[tuple[float, int]] = []
    for begin, end in _intervals(len(value)):
        part, its_std = value[begin:end], std[begin:end]
        places = np.arange(SIDE, len(part) - SIDE + 1)
        blocks = np.array_split(places, -(-len(places) * len(part) // BLOCK))
        p_values = np.concatenate([_p_values(part, its_std, block) for block in blocks])
        tested += zip(p_values.tolist(), (begin + places).tolist(), strict=True)
    p_value, place = min(tested)
    return place, min(1.0, p_value * len(tested))


def _intervals(count: int) -> Iterator[tuple[int, int]]:
    """The whole, and halves, quarters, ... of it that overlap by half, down to SHORTEST."""
    length = count
    while length >= SHORTEST:
        for begin in np.linspace(0, count - length, 2 * round(count / length) - 1).astype(int).tolist():
            yield begin, begin + length
        length = -(-length // 2)


def _p_values(value: Array, std: Array, places: NDArray[np.int_]) -> Array:
    """Of a step at each of `places`, if it were the only one, (places,)."""
    after = np.arange(len(value)) >= places[:, None]
    parts = np.stack((~after, after), axis=1)
    found = _means(value, std, parts)
    statistic = np.abs(np.diff(found.mean)[:, 0]) / np.sqrt(found.variance.sum(axis=-1))
    return np.asarray(2.0 * t_sf(statistic, found.freedom))


@dataclass(frozen=True, slots=True)
class _Means:
    """`mean` of each part and its `variance`, (..., parts), with the tau of each division; `freedom`: Satterthwaite's
    degrees of freedom of the sum of the variances, (...)."""

    mean: Array
    variance: Array
    freedom: Array


def _means(value: Array, std: Array, parts: NDArray[np.bool_]) -> _Means:
    """For divisions into `parts`, (..., parts, n), which say which estimate is in which."""
    unit = float(np.median(std))  # so that the precision is relative
    value, std = value / unit, std / unit
    freedom = len(value) - parts.shape[-2]
    tau2 = np.zeros(parts.shape[:-2])
    for _ in range(ITERATIONS):
        weight = parts / (std**2 + tau2[..., None, None])
        total = weight.sum(axis=-1)
        mean = (weight * value).sum(axis=-1) / total
        square = weight * (value - mean[..., None]) ** 2
        excess = square.sum(axis=(-2, -1)) - freedom
        if not np.any(excess > PRECISION * freedom):
            break
        slope = (weight * square).sum(axis=(-2, -1))
        tau2 = tau2 + np.where(excess > 0.0, excess / np.where(slope > 0.0, slope, 1.0), 0.0)
    # How tau^2 acts on the variances, and on the expected sum of squares, whose own variance is 2 n - 2 parts.
    share = (weight**2).sum(axis=-1) / total
    on_variance, on_squares = (share / total).sum(axis=-1), (total - share).sum(axis=-1)
    own = (1.0 / total).sum(axis=-1) * on_squares / on_variance
    return _Means(unit * mean, unit**2 / total, own**2 / freedom)
