"""The minimiser of all fits compared with scipy on the same problem, and its bounds."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
from scipy.optimize import least_squares

from upright.estimators.fit.gauss_newton import Block, Expansion, Normal, descend, minimise

TIME = np.linspace(0.0, 3.0, 60)
RANDOM = np.random.default_rng(8)
STARTS = (1.0, -2.0, 3.0)
DATA = [start * np.exp(-0.7 * TIME) + 0.4 + 0.01 * RANDOM.standard_normal(len(TIME)) for start in STARTS]


def evaluate(common: np.ndarray, own: Sequence[np.ndarray]) -> list[Block] | None:
    """Exponential decays with a common rate and offset, each from a start of its own."""
    rate, offset = common
    if rate > 50.0:
        return None
    blocks = []
    for data, (start,) in zip(DATA, own, strict=True):
        decay = np.exp(-rate * TIME)
        derivatives = np.stack((-start * TIME * decay, np.ones_like(TIME)), axis=1)
        blocks.append(Block(start * decay + offset - data, derivatives, decay[:, None]))
    return blocks


def fit(lower: Sequence[float] = (-np.inf, -np.inf), upper: Sequence[float] = (np.inf, np.inf)):  # type: ignore[no-untyped-def]
    return minimise(
        evaluate,
        np.array([0.3, 0.0]),
        [np.array([0.5]), np.array([-0.5]), np.array([0.5])],
        scale=np.array([1.0, 1.0]),
        lower=np.array(lower),
        upper=np.array(upper),
        tolerance=1e-10,
        enough=1e-16,
    )


def test_minimum_and_covariance_match_scipy_with_all_unknowns_at_once() -> None:
    def residual(z: np.ndarray) -> np.ndarray:
        return np.concatenate([z[2 + k] * np.exp(-z[0] * TIME) + z[1] - DATA[k] for k in range(3)])

    peer = least_squares(residual, [0.3, 0.0, 0.5, -0.5, 0.5], xtol=1e-14, ftol=1e-14, gtol=1e-14)
    found = fit()
    assert found.converged
    assert np.concatenate((found.common, *found.own)) == pytest.approx(peer.x, rel=1e-6)
    covariance = np.linalg.inv(peer.jac.T @ peer.jac)[:2, :2]
    assert np.linalg.inv(found.information) == pytest.approx(covariance, rel=1e-5)


def test_active_bound_is_respected_and_reported() -> None:
    found = fit(lower=(0.9, -np.inf))
    assert found.converged
    assert found.common[0] == 0.9
    assert found.at_bound.tolist() == [True, False]


def test_undefined_start_gives_none_and_undefined_regions_are_avoided() -> None:
    assert (
        minimise(
            lambda common, own: None,
            np.zeros(1),
            [],
            scale=np.ones(1),
            lower=np.full(1, -np.inf),
            upper=np.full(1, np.inf),
        )
        is None
    )
    assert fit(upper=(60.0, np.inf)).common[0] == pytest.approx(0.7, abs=0.02)


@pytest.mark.parametrize("bend", [-0.9, -2.0])
def test_large_residual_problem_on_which_gauss_newton_oscillates_converges(bend: float) -> None:
    """x + 1 and bend x^2 + x - 1 (Dennis and Schnabel, "Numerical methods", example 10.2.4) have their least sum of
    squares at 0, where Gauss-Newton multiplies the distance by `bend`. The curvature that it neglects is estimated in a
    few steps."""

    def expand(common: np.ndarray, own: Sequence[np.ndarray]) -> Expansion:
        (x,) = common
        residual, slope = np.array([x + 1.0, bend * x**2 + x - 1.0]), np.array([[1.0], [2.0 * bend * x + 1.0]])
        return Expansion(0.5 * float(residual @ residual), (Normal(slope.T @ slope, slope.T @ residual),))

    found = descend(
        expand,
        np.array([0.2]),
        [np.zeros(0)],
        scale=np.ones(1),
        lower=np.full(1, -np.inf),
        upper=np.full(1, np.inf),
        iterations=12,
        tolerance=0.0,
        enough=1e-14,
        watched=0,
    )
    assert found is not None
    minimum, _ = found
    assert minimum.converged
    assert minimum.common[0] == pytest.approx(0.0, abs=1e-6)
