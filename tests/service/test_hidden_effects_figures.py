"""The figures of the hidden-effects benchmark, against such that were calculated by hand or are in published tables."""

from __future__ import annotations

import json
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest

from upright.estimators.disturbance_estimate import DisturbanceEstimate
from upright.service.hidden_effects.cases import Kind
from upright.service.hidden_effects.methods.answers import MISSING, UNKNOWN, of_diagnosis
from upright.service.hidden_effects.results.summary import middle, share, summarise
from upright.service.hidden_effects.revision import closed


def _line(
    kind: Kind, effects: list[str], size: float, answer: dict[str, Any], excitation: str = "hold"
) -> dict[str, Any]:
    reported = {"verdict": MISSING, "found": [], "covered": {}, "seconds": 1.0, "error": "", **answer}
    return {
        "key": f"{effects}{size}{excitation}{json.dumps(answer)}",
        "kind": kind.value,
        "effects": effects,
        "size": size,
        "noise": 1.0,
        "excitation": excitation,
        "status": "ok",
        "conditions": "x",
        "methods": {"m": reported},
    }


def _named(*effects: str, tied: tuple[str, ...] = ()) -> dict[str, Any]:
    return {"found": [{"effect": effect, "tied_with": list(tied), "parameters": {}} for effect in effects]}


def test_figures_of_a_small_set_equal_those_calculated_by_hand() -> None:
    one, two, strange, nothing = Kind.ONE, Kind.TWO, Kind.UNLISTED, Kind.NOTHING
    lines = [
        # Right, tied with one, tied with two (wrong), another name, failed, right but too small to count as seen.
        _line(one, ["a"], 2.0, {**_named("a"), "held_out_closed": 0.9, "covered": {"a": True}}),
        _line(one, ["a"], 2.0, {**_named("b", tied=("a",)), "held_out_closed": 1.0, "energy_over_floor": 1.02}),
        _line(one, ["a"], 4.0, {**_named("a", tied=("b", "c")), "held_out_closed": None, "verdict": UNKNOWN}),
        _line(one, ["b"], 4.0, {**_named("c", "b"), "held_out_closed": 0.2, "covered": {"b": False}}, "sweep"),
        {**_line(one, ["b"], 4.0, {}, "sweep"), "methods": {"m": {"error": "E", "seconds": 3.0}}},
        _line(one, ["b"], 1.0, {**_named("b"), "held_out_closed": 0.0}),
        # Both in either order, one alone, and one name for two effects.
        _line(two, ["a", "b"], 2.0, _named("b", "a")),
        _line(two, ["a", "b"], 2.0, _named("a")),
        _line(two, ["a", "b"], 8.0, _named("c", tied=("a",)) | {"verdict": MISSING}),
        _line(strange, ["test_x"], 2.0, _named("b") | {"verdict": UNKNOWN}),
        _line(strange, ["test_x"], 2.0, _named("a")),
        _line(strange, ["test_x"], 4.0, {"verdict": "adequate"}),
        _line(nothing, [], 0.0, {"verdict": "adequate", "energy_over_floor": 1.0}),
        _line(nothing, [], 0.0, {"verdict": UNKNOWN, "energy_over_floor": 0.98}, "sweep"),
        _line(nothing, [], 0.0, {"verdict": "insufficient_data"}, "hold"),
        {"status": "not_recorded", "key": "x", "kind": "one", "methods": {}, "conditions": "x"},
    ]
    summary = summarise(lines)
    assert dict(summary.cases) == {"ok": 15, "not_recorded": 1}
    merit = summary.methods["m"]

    def counted(figure: Any) -> tuple[int | None, int]:
        return figure.count, figure.of

    assert counted(merit.right_seen) == (2, 5)
    assert {size: counted(each) for size, each in merit.right.items()} == {"2": (2, 2), "4": (0, 3), "1": (1, 1)}
    assert {name: counted(each) for name, each in merit.right_by_excitation.items()} == {
        "hold": (2, 3),
        "sweep": (0, 2),
    }
    assert counted(merit.seen_unknown) == (1, 5)
    assert counted(merit.false_alarms_all) == (1, 3)
    assert {name: counted(each) for name, each in merit.false_alarms.items()} == {"hold": (0, 2), "sweep": (1, 1)}
    assert counted(merit.false_names) == counted(merit.false_names_that_matter) == (1, 12)
    assert counted(merit.unlisted_unknown) == (1, 3)
    assert counted(merit.unlisted_misnamed) == (1, 3)
    assert counted(merit.both_seen) == (1, 3)
    assert (merit.held_out_closed.value, merit.held_out_closed.of) == (0.9, 3)
    assert (merit.energy_over_floor.value, merit.energy_over_floor.of) == (1.0, 3)
    assert counted(merit.covered) == (1, 2)
    assert (merit.seconds.value, merit.seconds.of) == (1.0, 15)
    assert merit.failed == 1
    assert {row: dict(columns) for row, columns in merit.confusion.items()} == {
        "a": {"a": 2, "b": 1},
        "b": {"c": 1, "failed": 1},
        "test_x": {"unknown": 1, "a": 1, "nothing": 1},
    }


def test_disturbance_coverage_is_separate_for_correctly_named_records() -> None:
    held, missed = ({"disturbance_covered": {"rms": holds}} for holds in (True, False))
    lines = [
        _line(Kind.NOTHING, [], 0.0, held),
        _line(Kind.ONE, ["a"], 2.0, _named("b", tied=("a", "c")) | held),
        _line(Kind.TWO, ["a", "b"], 2.0, _named("b", "a") | missed),
        # One of two named, one name too many, and an effect outside the catalogue.
        _line(Kind.TWO, ["a", "b"], 2.0, _named("a") | missed),
        _line(Kind.ONE, ["a"], 2.0, _named("a", "c") | missed),
        _line(Kind.UNLISTED, ["test_x"], 2.0, {"verdict": UNKNOWN} | missed),
    ]
    merit = summarise(lines).methods["m"]
    of_all, named = (each["rms"] for each in (merit.disturbance_covered, merit.disturbance_covered_named))
    assert (of_all.count, of_all.of) == (2, 6)
    assert (named.count, named.of) == (2, 3)


def test_false_names_that_are_called_negligible_are_counted_separately() -> None:
    beside = _named("a", "b")
    beside["found"][1]["negligible"] = True
    lines = [_line(Kind.ONE, ["a"], 2.0, beside), _line(Kind.ONE, ["a"], 2.0, _named("a", "c"))]
    merit = summarise(lines).methods["m"]
    assert (merit.false_names.count, merit.false_names_that_matter.count) == (2, 1)


def test_confidence_intervals_equal_published_tables() -> None:
    """Wilson's for 8 of 10 as in Newcombe, Statistics in Medicine 17 (1998); the median's as in Conover, table A3."""
    found = share([True] * 8 + [False] * 2)
    assert (found.value, found.low, found.high) == pytest.approx((0.8, 0.4902, 0.9433), abs=5e-5)
    assert share([]).value is None
    ten = middle([*map(float, range(1, 11)), None])
    assert (ten.value, ten.low, ten.high, ten.of) == (5.5, 2.0, 9.0, 10)
    few = middle([1.0, 2.0, 3.0])
    assert (few.value, few.low, few.of) == (2.0, None, 3)


def test_closed_error_is_the_share_between_nominal_and_right_model() -> None:
    assert closed(3.0, 1.5, 1.0) == 0.75
    assert closed(1.0, 1.0, 1.0) is None


def test_diagnosis_is_converted_into_an_answer() -> None:
    def parameter(value: float | None) -> SimpleNamespace:
        return SimpleNamespace(value=value, std=None if value is None else 2.0)

    finding = SimpleNamespace(
        effect="coulomb_friction",
        tied_with=("hysteresis",),
        parameters={"torque": parameter(61.0), "other": parameter(None)},
        negligible=True,
    )
    estimate = DisturbanceEstimate("roll", "N m", 8.0, 0.4, 0.3, 0.03)
    found = SimpleNamespace(
        verdict=MISSING, findings=(finding,), revised=None, minimum_detectable={"x": 1.0}, disturbance=(estimate,)
    )
    answer = of_diagnosis(found)
    assert answer.disturbance == {"rms": (8.0, 0.4), "correlation_time": (0.3, 0.03)}
    bounded = replace(estimate, shown=False, std_error=None, correlation_time=None, correlation_time_error=None)
    assert of_diagnosis(SimpleNamespace(**{**vars(found), "disturbance": (bounded,)})).disturbance == {}
    assert answer.found[0].names == {"coulomb_friction", "hysteresis"}
    assert answer.found[0].parameters == {"torque": (61.0, 2.0)}
    assert answer.found[0].negligible
    assert answer.detectable == {"x": 1.0}
    unknown = of_diagnosis(SimpleNamespace(**{**vars(found), "verdict": UNKNOWN, "minimum_detectable": None}))
    assert (unknown.verdict, unknown.found, unknown.detectable) == (UNKNOWN, answer.found, {})
