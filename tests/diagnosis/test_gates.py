"""The gates decide about fitted effects by their numbers alone, and a table of these numbers decides the same."""

from __future__ import annotations

import json
from dataclasses import replace

import pytest

from benchmarks import decisions
from upright.diagnosis.gates import CHECKED, GATES, HeldOut, Round, Tried, decide, gated
from upright.models.effects.catalogue import find

ROWS = 6000
STANDS = HeldOut(gain=300.0, std=20.0, closed_percent=90.0, closed_std=5.0, closing_percent=90.0)
FAILS = HeldOut(gain=5.0, std=20.0, closed_percent=90.0, closed_std=5.0, closing_percent=90.0)


def fitted(name: str, log_likelihood: float, parameters: int = 1, **changes: object) -> Tried:
    """An effect that passes every gate, apart from `changes`."""
    usual = Tried(name, find(name), log_likelihood, parameters, ROWS, True, True, t_ratio=30.0, p_value=1e-9)
    return replace(usual, **changes)  # type: ignore[arg-type]


def decided(*tried: Tried, held_out: dict[str, HeldOut | None] | None = None, p_value: float = 1e-9) -> Round:
    """The decision if these are the only effects fitted of thirty; held-out data confirm all except by `held_out`."""
    undecided = Round((), 30, tuple(gated(each, 30) for each in tried), p_value)
    known = held_out or {}
    return decide(undecided, lambda best: replace(best, held_out=known.get(best.name, STANDS)), lambda other: None)


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({}, ""),
        ({"converged": False}, "its fit does not converge"),
        ({"inside_bounds": False}, "its amplitude ends at a bound"),
        ({"t_ratio": 1.5}, "its t-ratio is 1.5, and more than 2 is needed"),
        ({"log_likelihood": 3.0}, "chance explains as much in 43 % of records"),
        ({"log_likelihood": 400.0, "usual": (3.0, 1)}, "chance explains as much in 43 % of records"),
    ],
)
def test_each_gate_refuses_with_its_reason(changes: dict[str, object], reason: str) -> None:
    tried = replace(fitted("viscous_friction", 300.0), **changes)  # type: ignore[arg-type]
    assert gated(tried, 30).refused == reason
    assert sum(bool(gate(tried, 30)) for gate in GATES) == bool(reason)


def test_likeliest_effect_that_passes_every_gate_is_named() -> None:
    found = decided(fitted("cubic_stiffness", 900.0, inside_bounds=False), fitted("viscous_friction", 300.0))
    assert (found.named, found.tied_with) == ("viscous_friction", ())
    assert found.tried[0].refused == "its amplitude ends at a bound"
    assert not decided(fitted("cubic_stiffness", 900.0, converged=False)).named


def test_nothing_is_named_if_chance_explains_the_best_of_all_effects_tried() -> None:
    assert not decided(fitted("viscous_friction", 300.0), p_value=0.02).named


def test_simpler_of_two_almost_equal_effects_is_named_and_the_other_is_tied() -> None:
    coulomb, stribeck = fitted("coulomb_friction", 300.0), fitted("stribeck_friction", 310.0, 3)
    found = decided(coulomb, stribeck)
    assert found.named == "coulomb_friction"
    assert found.tied_with == ("stribeck_friction",)
    assert decided(coulomb, replace(stribeck, log_likelihood=400.0)).named == "stribeck_friction"


def test_next_effect_is_named_if_held_out_data_reject_the_first() -> None:
    first, second = fitted("viscous_friction", 300.0), fitted("cubic_stiffness", 200.0)
    found = decided(first, second, held_out={"viscous_friction": FAILS})
    assert found.named == "cubic_stiffness"
    assert found.tried[0].refused == "does not hold on held-out data"


def test_after_a_rejection_no_effect_is_named_without_a_held_out_result() -> None:
    first, second = fitted("viscous_friction", 300.0), fitted("cubic_stiffness", 200.0)
    assert decided(first, held_out={"viscous_friction": None}).named == "viscous_friction"
    assert not decided(first, second, held_out={"viscous_friction": FAILS, "cubic_stiffness": None}).named


def test_number_of_effects_checked_on_held_out_data_is_limited() -> None:
    names = ("viscous_friction", "cubic_stiffness", "hysteresis", "end_stop")
    tried = [fitted(name, 300.0 - 50.0 * place) for place, name in enumerate(names)]
    refused = dict.fromkeys(names[:CHECKED], FAILS)
    assert not decided(*tried, held_out=refused).named  # type: ignore[arg-type]


def test_effect_that_formulas_before_may_leave_is_not_named_but_covered() -> None:
    found = decided(fitted("viscous_friction", 90.0, left=100.0), fitted("cubic_stiffness", 50.0))
    assert (found.named, found.covered) == ("", "viscous_friction")
    assert found.tried[0].refused == "formulas found before may leave as much: a log-likelihood ratio of 100"
    assert decided(fitted("viscous_friction", 101.0, left=100.0)).named == "viscous_friction"


def test_table_reproduces_the_decision_and_names_missing_held_out_data() -> None:
    found = decided(fitted("coulomb_friction", 300.0), fitted("stribeck_friction", 310.0, 3), fitted("end_stop", 2.0))
    line = {
        "case": "monocab still coulomb_friction",
        "hidden": ["coulomb_friction"],
        "unlisted": False,
        "verdict": "missing_effect",
        "named": [["coulomb_friction", "stribeck_friction"]],
        "rounds": [decisions._short(decisions._round_line(found))],
    }
    line = json.loads(json.dumps(line))
    assert decisions.decided_again(line) == []
    assert decisions.right(line)
    assert decisions.false_names(line) == 0
    (text,) = decisions.summary([line])
    assert "right   1 of   1, false names  0" in text
    other = json.loads(json.dumps(line))
    other["rounds"][0]["tried"][1]["log_likelihood"] = 400.0
    ((_, how),) = decisions.decided_again(other)
    assert how == (
        "coulomb_friction = stribeck_friction is now stribeck_friction, and needs held-out data about stribeck_friction"
    )
    changed = {**line, "named": [["stribeck_friction"]]}
    (text,) = decisions.difference({line["case"]: line}, {line["case"]: changed})
    assert text.startswith("WORSE")


def test_every_case_of_the_regression_test_has_a_unique_name() -> None:
    names = [each.name for each in decisions.cases()]
    assert len(names) == len(set(names)) >= 280


def test_table_in_the_repository_is_decided_again_without_a_difference() -> None:
    table = decisions.read_table(decisions.KEPT)
    assert sum(len(line["rounds"]) for line in table.values()) > 100
    assert [each for line in table.values() for each in decisions.decided_again(line)] == []
