"""Which effect, and from which second on: the search for change points, on synthetic columns of known truth."""

from __future__ import annotations

import numpy as np
import pytest

from upright.diagnosis.live.odds import weigh
from upright.diagnosis.live.onset import BEGINNING, Amplitudes, Onset
from upright.diagnosis.live.products import Products

ROWS = 200
"""Samples per second."""
NUISANCES = 3
FREE = (-np.inf, np.inf)
EFFECTS = (
    Amplitudes("first", (3,), (FREE[0],), (FREE[1],)),
    Amplitudes("second", (4,), (FREE[0],), (FREE[1],)),
    Amplitudes("braking", (5,), (0.0,), (np.inf,)),
    Amplitudes("pair", (6, 7), (FREE[0],) * 2, (FREE[1],) * 2),
    Amplitudes("built_in", (8,), (FREE[0],), (FREE[1],), anytime=False),
)


def gathered(
    seed: int, seconds: int, acts: dict[int, tuple[float, float]], *, kept: int = 32, held: tuple[int, ...] = ()
) -> Products:
    """`acts`: for each column its amplitude and the time, s, from which on it acts. The noise has unit variance.

    Neighbouring columns have a correlation of 0.8, and of 0.5 with the nuisances, like those of real effects.
    """
    rng = np.random.default_rng(seed)
    products = Products(np.full(NUISANCES, 1e-2), np.zeros(NUISANCES), 10, kept)
    for second in range(seconds):
        common = rng.standard_normal((ROWS, 1))
        columns = 0.8 * common + 0.6 * rng.standard_normal((ROWS, 9))
        time = second + np.arange(ROWS) / ROWS
        noise = rng.standard_normal(ROWS)
        observed = noise + columns[:, :NUISANCES] @ [1.0, -2.0, 0.5]
        for column, (amplitude, begin) in acts.items():
            observed += amplitude * columns[:, column] * (time >= begin)
        products.add(np.column_stack((columns, observed)))
        products.end_second(held)
    return products


def named(products: Products, known: tuple[Onset, ...] = ()) -> list[Onset]:
    return [each.onset for each in weigh(products, EFFECTS, known, {}, 0.0)[0]]


@pytest.mark.parametrize("begin", [12.0, 12.5, 12.9])
def test_effect_is_found_with_its_amplitude_and_its_change_point(begin: float) -> None:
    found = named(gathered(1, 24, {3: (0.3, begin)}))
    assert found[0].effect.name == "first"
    # Amplitudes in the second of the onset are free: an effect that acts throughout it may be dated a second later.
    assert begin - 1.0 < found[0].second < begin + 1.2
    # Five standard errors: the error of one draw in a million is larger.
    assert abs(found[0].sizes[0] - 0.3) < 5.0 * found[0].standard_errors[0]
    assert found[0].statistic > 100.0


def test_effect_present_from_the_beginning_has_no_change_point() -> None:
    assert named(gathered(2, 24, {4: (0.2, 0.0)}))[0].second == BEGINNING


def test_second_effect_is_found_given_the_first_and_no_third_is() -> None:
    products = gathered(3, 30, {3: (0.4, 8.5), 6: (0.2, 0.0), 7: (-0.2, 0.0)})
    first = named(products)[0]
    second = named(products, (first,))[0]
    assert {first.effect.name, second.effect.name} == {"first", "pair"}
    rest = named(products, (first, second))
    assert not rest or rest[0].statistic < 25.0  # chi-squared with 1 or 2 dof: below this 99.9996 % of the time


def test_friction_of_a_driving_sign_is_excluded() -> None:
    found = {each.effect.name: each for each in named(gathered(4, 24, {5: (-0.3, 0.0)}))}
    assert "braking" not in found or found["braking"].sizes[0] == 0.0


def test_structural_effect_has_no_change_point() -> None:
    found = {each.effect.name: each for each in named(gathered(5, 24, {8: (0.5, 12.0)}))}
    assert found["built_in"].second == BEGINNING


def test_statistics_of_pure_noise_stay_below_the_bonferroni_threshold() -> None:
    """60 records of 40 s: at a level of 1 % for all of them together, no effect may be named (seeds fixed)."""
    from scipy.stats import chi2

    threshold = chi2.isf(0.01 / (60 * len(EFFECTS) * 40), 2)
    most = [max((each.statistic for each in named(gathered(100 + seed, 40, {}))), default=0.0) for seed in range(60)]
    assert max(most) < threshold


def test_block_boundary_at_a_found_change_point_is_kept() -> None:
    """16 blocks are kept. An effect from 10.5 s on is still found after 80 s, within five standard errors."""
    products = gathered(6, 80, {3: (0.3, 10.5)}, kept=16, held=(11,))
    blocks, starts = products.latest()
    assert len(blocks) == 16
    assert {10, 11} <= set(starts.tolist())
    assert sum(block[-1, -1] for block in blocks) > 0.9 * 80 * ROWS
    best = named(products)[0]
    assert (best.effect.name, best.second) == ("first", 11)
    assert abs(best.sizes[0] - 0.3) < 5.0 * best.standard_errors[0]


def test_noise_in_bursts_inflates_the_variance_of_the_score() -> None:
    """The innovations of every other second are three times as large: scores scatter more than the information says."""
    rng = np.random.default_rng(7)
    products = Products(np.full(NUISANCES, 1e-2), np.zeros(NUISANCES), 10, 32)
    for second in range(30):
        loud = 3.0 if second % 2 else 0.3
        columns = rng.standard_normal((ROWS, 9))
        shape = columns[:, 3] * loud
        products.add(np.column_stack((columns, loud * rng.standard_normal(ROWS) + 0.1 * shape)))
        products.end_second()
    (first,) = [each for each in named(products) if each.effect.name == "first"]
    assert first.inflation > 2.0


def test_effect_identical_to_a_nuisance_is_left_out() -> None:
    rng = np.random.default_rng(8)
    products = Products(np.zeros(NUISANCES), np.zeros(NUISANCES), 10, 32)
    for _ in range(12):
        columns = rng.standard_normal((ROWS, 9))
        columns[:, 3] = columns[:, 0]
        products.add(np.column_stack((columns, rng.standard_normal(ROWS) + columns[:, 4])))
        products.end_second()
    found, errors = weigh(products, EFFECTS, (), {}, 0.0)
    assert found[0].onset.effect.name == "second"
    assert "first" not in errors
    assert all(each.onset.effect.name != "first" for each in found)
    assert errors["second"] == pytest.approx(1.0 / np.sqrt(12 * ROWS), rel=0.1)
