"""Tail probabilities of the distributions that tests need: the numbers of scipy.stats, whose import takes as long as
that of everything else together.

`sf(x)` is the probability of more than x, `isf` its inverse. Arguments are numbers or arrays, which are broadcast.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import special

Array = NDArray[np.float64]


def chi2_sf(x: ArrayLike, freedom: ArrayLike) -> Any:
    return special.chdtrc(freedom, np.maximum(x, 0.0))


def chi2_isf(probability: ArrayLike, freedom: ArrayLike) -> Any:
    return special.chdtri(freedom, probability)


def chi2_ppf(probability: ArrayLike, freedom: ArrayLike) -> Any:
    """The quantile: less is found with this probability."""
    return 2.0 * special.gammaincinv(0.5 * np.asarray(freedom), probability)


def f_sf(x: ArrayLike, freedom: ArrayLike, freedom_below: ArrayLike) -> Any:
    """Of a ratio of mean squares, with degrees of freedom of its numerator and of its denominator."""
    return special.fdtrc(freedom, freedom_below, np.maximum(x, 0.0))


def t_sf(x: ArrayLike, freedom: ArrayLike) -> Any:
    return special.stdtr(freedom, -np.asarray(x))


def normal_sf(x: ArrayLike) -> Any:
    return special.ndtr(-np.asarray(x))


def normal_isf(probability: ArrayLike) -> Any:
    return -special.ndtri(probability)


def adjusted(p_values: ArrayLike) -> Array:
    """p-values (n,) of n tests, adjusted for the rate of false discoveries (Benjamini and Hochberg, J. R. Stat. Soc. B
    57, 1995)."""
    found = np.asarray(p_values, dtype=np.float64)
    order = np.argsort(found)[::-1]
    ranks = np.arange(len(found), 0, -1)
    result = np.empty_like(found)
    result[order] = np.minimum.accumulate(np.minimum(found[order] * (len(found) / ranks), 1.0))
    return result
