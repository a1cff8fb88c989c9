"""Tail probabilities are those of scipy.stats, to the last bit, without its import."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from scipy import stats

from upright.estimators import tails

RANDOM = np.random.default_rng(4)
X = np.concatenate((RANDOM.uniform(-3.0, 60.0, 500), [0.0, np.inf, -1.0]))
PROBABILITY = np.concatenate((RANDOM.uniform(0.0, 1.0, 501), [1e-12, 1.0 - 1e-12]))
FREEDOM, BELOW = RANDOM.integers(1, 300, (2, 503))


@pytest.mark.parametrize(
    ("ours", "theirs", "arguments"),
    [
        (tails.chi2_sf, stats.chi2.sf, (X, FREEDOM)),
        (tails.chi2_isf, stats.chi2.isf, (PROBABILITY, FREEDOM)),
        (tails.chi2_ppf, stats.chi2.ppf, (PROBABILITY, FREEDOM)),
        (tails.f_sf, stats.f.sf, (X, FREEDOM, BELOW)),
        (tails.t_sf, stats.t.sf, (X, FREEDOM)),
        (tails.normal_sf, stats.norm.sf, (X,)),
        (tails.normal_isf, stats.norm.isf, (PROBABILITY,)),
        (tails.adjusted, stats.false_discovery_control, (PROBABILITY,)),
    ],
)
def test_numbers_are_those_of_scipy_stats(
    ours: Callable[..., Any], theirs: Callable[..., Any], arguments: tuple[Any, ...]
) -> None:
    np.testing.assert_array_equal(ours(*arguments), theirs(*arguments))


def test_a_diagnosis_does_not_import_scipy_stats() -> None:
    code = (
        "import sys, upright; upright.diagnose, upright.compare, upright.identify; print('scipy.stats' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=60)
    assert done.stdout.strip() == "False"
