"""The odds of effects for any onset, on synthetic columns whose truth is known."""

from __future__ import annotations

import math

import numpy as np
import pytest
from test_onset import EFFECTS, gathered

from upright.diagnosis.live.odds import Weighed, tied_from, weigh
from upright.diagnosis.live.onset import BEGINNING, Amplitudes
from upright.diagnosis.live.products import Products


def weighed(products: Products, least: float = 0.0, **tries: int) -> list[Weighed]:
    return weigh(products, EFFECTS, (), tries, least)[0]


@pytest.mark.parametrize(("begin", "column"), [(12.4, 3), (12.9, 4), (0.0, 3), (12.4, 5)])
def test_effect_that_acts_has_the_highest_odds_at_its_onset(begin: float, column: int) -> None:
    found = weighed(gathered(1, 24, {column: (0.3, begin)}), 10.0)
    name = next(each.name for each in EFFECTS if each.columns == (column,))
    assert found[0].onset.effect.name == name
    assert abs(found[0].onset.second - begin) < 1.2
    assert found[0].explained > 0.5
    assert [each.tied for each in found] == [True] + [False] * (len(found) - 1)


def test_high_odds_are_rare_if_nothing_acts() -> None:
    """Odds of x : 1 occur with a probability of about 1 / x; 200 draws, each with the best of five effects.

    Odds of 100 are expected at most five times as often: in 10 of 200 draws; 20 of them occur once in 500 times."""
    highest = [max((each.log_odds for each in weighed(gathered(seed, 16, {}))), default=0.0) for seed in range(200)]
    assert sum(each > math.log(100.0) for each in highest) < 20


def test_impossible_amplitude_has_no_odds() -> None:
    found = weighed(gathered(2, 20, {5: (-0.3, 0.0)}))
    assert "braking" not in {each.onset.effect.name for each in found}


@pytest.mark.parametrize(("acts", "likeliest"), [({6: 0.3}, "one"), ({6: 0.3, 7: -0.3}, "pair")])
def test_second_amplitude_has_to_explain_more_than_its_price(acts: dict[int, float], likeliest: str) -> None:
    effects = (Amplitudes("one", (6,), (-np.inf,), (np.inf,)), EFFECTS[3])
    products = gathered(3, 24, {column: (size, 12.0) for column, size in acts.items()})
    found, _ = weigh(products, effects, (), {}, 10.0)
    assert found[0].onset.effect.name == likeliest


def test_effect_that_is_built_in_has_no_onset() -> None:
    found = weighed(gathered(4, 24, {8: (0.3, 0.0)}), 10.0)
    assert (found[0].onset.effect.name, found[0].onset.second) == ("built_in", BEGINNING)


def test_odds_are_divided_by_the_number_of_shapes_tried() -> None:
    products = gathered(1, 24, {3: (0.3, 12.0)})
    (free, *_), (dear, *_) = weighed(products), weighed(products, first=1000)
    assert free.log_odds - dear.log_odds == pytest.approx(math.log(1000.0))


def test_nothing_is_returned_below_the_required_odds() -> None:
    products = gathered(1, 24, {3: (0.3, 12.0)})
    highest = weighed(products)[0].log_odds
    assert weighed(products, highest + 1.0) == []


def test_effect_that_explains_little_of_a_disturbance_reports_a_small_share() -> None:
    """Ten times the usual noise from 20 s on, of which some effect always explains most."""
    products = gathered(5, 20, {})
    rng = np.random.default_rng(6)
    for _ in range(4):
        products.add(np.column_stack((rng.standard_normal((200, 9)), 10.0 * rng.standard_normal(200))))
        products.end_second()
    found = weighed(products)
    assert found
    assert max(each.explained for each in found) < 0.1


def test_ties_widen_with_the_odds() -> None:
    assert tied_from(10.0) == pytest.approx(10.0 - math.log(20.0))
    assert tied_from(100.0) == pytest.approx(90.0)
