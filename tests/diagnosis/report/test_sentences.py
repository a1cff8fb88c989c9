"""Sentences on a diagnosis that all outputs share: the disturbance, negligible effects, untried effects."""

from __future__ import annotations

import json
from dataclasses import replace

import pytest

from upright.diagnosis.diagnose import Diagnosis, Finding, Verdict
from upright.diagnosis.explain import explained_by_none, together
from upright.diagnosis.parts import merged
from upright.diagnosis.prediction.closed_loop_error import Loop
from upright.diagnosis.prediction.relevance import Relevance, percent
from upright.diagnosis.report.sentences import (
    disturbance_sentences,
    disturbance_text,
    mattering,
    to_within,
    two_digits,
    untried_sentence,
)
from upright.estimators.disturbance_estimate import DisturbanceEstimate

SHAKEN = DisturbanceEstimate("roll", "N m", 8.1, 0.4, 0.31, 0.03)
STILL = DisturbanceEstimate("roll", "N m", 2.0, None, None, None, shown=False)
STATED = DisturbanceEstimate("roll", "N m", 8.0, None, 0.3, None, known=True)


def finding(effect: str, gain: float, ahead: float) -> Finding:
    return Finding(
        effect=effect,
        family="",
        parameters={},
        probability=1.0,
        p_value=0.0,
        tied_with=(),
        explanation=f"{effect} explained",
        log_likelihood_gain=gain,
        held_out=None,
        odds={effect: 1.0},
        relevance=Relevance(0.5, ahead),
    )


@pytest.mark.parametrize("each", [SHAKEN, STILL, STATED], ids=["shaken", "still", "stated"])
def test_disturbance_is_unchanged_after_a_round_trip_through_json(each: DisturbanceEstimate) -> None:
    assert DisturbanceEstimate.from_json("roll", json.loads(json.dumps(each.to_json()))) == each


def test_adequate_model_explains_to_within_noise_and_the_disturbance() -> None:
    assert to_within(Diagnosis(Verdict.ADEQUATE, "", disturbance=(STILL,))) == "to within their noise"
    shaken = Diagnosis(Verdict.ADEQUATE, "", disturbance=(SHAKEN,))
    assert to_within(shaken) == "to within their noise and a random disturbance of 8.10 ± 0.40 N m RMS"
    two = (SHAKEN, DisturbanceEstimate("pitch", "N m", 1.0, 0.1, 0.2, 0.02))
    assert "8.10 ± 0.40 N m RMS at roll and 1.00 ± 0.10 N m RMS at pitch" in to_within(
        Diagnosis(Verdict.ADEQUATE, "", disturbance=two)
    )


def test_lead_of_a_finding_is_over_the_next_effect_or_over_none() -> None:
    alone = finding("backlash", 80.0, 0.1)
    assert alone.lead == 80.0
    followed = replace(alone, gains={"backlash": 1.0, "hysteresis": 0.75, "static_torque": 0.5})
    assert followed.lead == 20.0
    assert replace(followed, gains={"backlash": 1.0, "hysteresis": 1.25}).lead == -20.0
    assert replace(followed, tied_with=("hysteresis",)).lead == 0.0


def test_disturbance_sentence_gives_an_estimate_or_an_upper_bound() -> None:
    sentence = disturbance_sentences(Diagnosis(Verdict.ADEQUATE, "", disturbance=(STILL,)))
    assert sentence == "Disturbance: none detected; less than 2 N m RMS."
    sentence = disturbance_sentences(Diagnosis(Verdict.ADEQUATE, "", disturbance=(SHAKEN,)))
    assert sentence == "Disturbance: 8.10 ± 0.40 N m RMS, correlation time 0.310 ± 0.030 s; no effect explains it."
    assert disturbance_sentences(Diagnosis(Verdict.ADEQUATE, "")) == ""
    assert disturbance_text((STILL,)) == "none detected; less than 2 N m RMS"


def test_large_error_is_written_without_a_power_of_ten() -> None:
    assert [two_digits(each) for each in (0.0317, 3.17, 99.4, 843.0)] == ["0.032", "3.2", "99", "840"]


def test_untried_effects_are_stated_with_the_remedy() -> None:
    hurried = Diagnosis(Verdict.UNKNOWN, "", untried=("hysteresis",))
    assert untried_sentence(hurried) == "Left untried for want of time: hysteresis. Remedy: --budget SECONDS."
    assert untried_sentence(hurried, 60.0).endswith("(60 s): hysteresis. Remedy: --budget 300.")
    assert untried_sentence(Diagnosis(Verdict.UNKNOWN, "")) == ""


def test_relevant_effect_is_explained_in_full_before_a_negligible_one() -> None:
    large, small = finding("viscous_friction", 10.0, 43.0), finding("sensor_lag", 90.0, 0.2)
    assert together([large, small]) == (
        "viscous_friction explained sensor_lag is detectable but negligible: "
        "it accounts for 0.2 % of the error energy 0.5 s ahead."
    )
    assert together([small]).startswith("nothing is missing that matters. sensor_lag is detectable")
    assert mattering(Diagnosis(Verdict.MISSING_EFFECT, "", (large, small))) == [large]
    assert (percent(43.2), percent(0.34), percent(0.0)) == ("43 %", "0.3 %", "none")


def test_relevant_effect_of_two_parts_comes_first_and_all_untried_are_listed() -> None:
    """A negligible effect may have more evidence: a long record shows it nevertheless."""
    large, small = finding("input_gain", 10.0, 43.0), finding("sensor_lag", 90.0, 0.2)
    vehicle = Diagnosis(Verdict.MISSING_EFFECT, "", (small,), untried=("hysteresis",))
    actuators = Diagnosis(Verdict.MISSING_EFFECT, "", (large,), untried=("actuator_lag",))
    found = merged(vehicle, actuators, [])
    assert [each.effect for each in found.findings] == ["input_gain", "sensor_lag"]
    assert found.reason.startswith("input_gain explained sensor_lag is detectable")
    assert found.untried == ("hysteresis", "actuators: actuator_lag")
    unknown = Diagnosis(Verdict.UNKNOWN, "swings", untried=("actuator_lag",))
    assert merged(vehicle, unknown, []).untried == found.untried


def test_loop_is_shifted_to_a_part_of_its_recording() -> None:
    whole = Loop(7.0, 40.0, lambda begins: lambda time, seen: {}, frozenset(), frozenset(), ())
    assert (whole.of_part(3.0).begins, whole.of_part(3.0).ends) == (4.0, 37.0)


def test_untried_effects_restrict_the_statement_that_none_explains() -> None:
    assert explained_by_none(()) == "no known effect explains"
    assert explained_by_none(("backlash",)) == "no effect tried so far explains"
