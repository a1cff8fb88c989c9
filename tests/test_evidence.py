"""One definition of what is asked for. That what a diagnosis names is needed, tests/test_hidden_catalogue.py asks."""

from __future__ import annotations

import math

import pytest

from diagnosis.evidence import ODDS, asked_for, likelier


@pytest.mark.parametrize("tries", [1.0, 40.0])
def test_each_of_many_has_to_be_likelier_by_their_number(tries: float) -> None:
    assert not likelier(math.log(0.99 * ODDS * tries), tries)
    assert likelier(math.log(1.01 * ODDS * tries), tries)


def test_odds_alone_do_not_ask_for_an_effect_whose_size_is_that_of_noise() -> None:
    assert not asked_for(1000.0, 2.9)
    assert asked_for(1000.0, 3.1)
