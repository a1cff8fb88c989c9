"""The report of a diagnosis: one page that states the findings, loads nothing and escapes all names."""

from __future__ import annotations

from dataclasses import replace

import matplotlib as mpl
import numpy as np
import pytest
from matplotlib.figure import Figure
from written_report import (
    FIGURES,
    HASH,
    HOSTILE,
    LARGEST,
    MODEL,
    PROVENANCE,
    VEHICLE,
    Page,
    found,
    of_little_matter,
    page,
    record,
    written,
)

from upright.diagnosis.diagnose import Diagnosis, Verdict
from upright.diagnosis.prediction.relevance import percent
from upright.diagnosis.report import write_report
from upright.diagnosis.report.figures.diagnosis import staircase
from upright.diagnosis.report.figures.drawing import MOST_POINTS, STYLE, in_a_row, separate, svg, thinned
from upright.diagnosis.report.names import shown
from upright.diagnosis.report.tables import HARD_SPACE, detectables, p_text
from upright.diagnosis.report.words import gist, headline
from upright.estimators.disturbance_estimate import rms
from upright.estimators.fit.random.disturbance import disturbances
from upright.estimators.numbers import with_error


class TestPage:
    def test_is_one_document_small_enough_to_mail(self) -> None:
        assert len(written().encode()) < LARGEST
        assert [len(page().all(tag)) for tag in ("html", "head", "body", "title", "h1", "footer")] == [1] * 6

    def test_loads_no_resources(self) -> None:
        assert not {"script", "link", "img", "iframe", "object", "embed"} & {tag for tag, _ in page().tags}
        for _, attributes in page().tags:
            for name in ("src", "href", "xlink:href", "data", "action"):
                assert attributes.get(name, "#").startswith("#")
            assert not any(name.startswith("on") for name in attributes)
        assert "@import" not in written()
        assert written().count("url(") == written().count("url(#") > 0

    def test_ids_are_unique_and_all_references_resolve(self) -> None:
        ids = [attributes["id"] for _, attributes in page().tags if "id" in attributes]
        assert len(ids) == len(set(ids)) > 0
        used = {attributes["xlink:href"][1:] for attributes in page().all("use")}
        assert used
        assert used <= set(ids)

    def test_has_a_print_layout(self) -> None:
        assert "@page { size: A4;" in written()
        assert "@media print" in written()

    def test_states_its_provenance(self) -> None:
        for text in (HASH, "monocab", "1.2.3", "2031-02-03 04:05", MODEL.name):
            assert text in page().text

    def test_shows_hostile_names_as_text(self) -> None:
        assert "<script" not in written()
        assert "<b>" not in written()
        assert HOSTILE in page().text  # in the footer, whole
        assert HOSTILE.rsplit("/", 1)[1] in page().text.split("Next:")[0]  # above, the last part of its path

    def test_shows_hostile_names_as_text_in_figures_too(self) -> None:
        with mpl.rc_context(STYLE):
            figure = Figure()
            separate(figure.subplots(), [0.0, 0.5], [HOSTILE, "other"])
            drawn = svg(figure, "name", "label")
        assert "<script" not in drawn
        assert HOSTILE in Page(drawn).text


class TestFindings:
    def test_verdict_comes_first(self) -> None:
        assert found().verdict is Verdict.MISSING_EFFECT
        before_figures = page().text.split("Measured against predicted")[0]
        assert "Missing effect: the model lacks coulomb_friction" in before_figures
        assert headline(found()).next_step in before_figures
        assert page().all("div")[0]["class"] == "verdict missing_effect"

    def test_every_figure_is_shown_with_its_curves(self) -> None:
        assert page().figures == list(FIGURES)
        for text in (
            "measured",
            "before, 0.5 s ahead",
            "after, 0.5 s ahead",
            "roll, deg",
            "roll_rate, deg/s",
            "by time",
        ):
            assert text in page().text

    def test_innovation_ratios_before_and_after_are_shown(self) -> None:
        before, after = found().innovation_ratio_before, found().innovation_ratio_after
        assert before is not None
        assert after is not None
        assert f"{before:.3g}" in page().text
        assert f"{after:.3g}" in page().text
        assert "with coulomb_friction" in page().text

    def test_probabilities_add_up_to_one_bar(self) -> None:
        # Each bar is a frame of 100 and its share: the shares add up to 100, to the two decimals that are written.
        widths = [float(each["width"]) for each in page().all("rect") if each.get("height") == "10"]
        assert all(width == 100.0 for width in widths[::2])
        assert sum(widths[1::2]) == pytest.approx(100.0, abs=0.05)

    def test_tied_effects_are_bracketed(self) -> None:
        finding = found().findings[0]
        brackets = [each for each in page().all("td") if each.get("class") == "tied"]
        expected = [str(1 + len(finding.tied_with))] if finding.tied_with else []
        assert [each["rowspan"] for each in brackets] == expected

    def test_named_effect_is_marked_in_its_ranking(self) -> None:
        assert [each.get("class") for each in page().all("tr")].count("named") == len(found().findings)

    def test_amplitudes_stand_beside_the_minimum_detectable_ones(self) -> None:
        torque = found().findings[0].parameters["coulomb_friction.torque"].value
        least = found().score_tests[0].score("coulomb_friction").detectable
        assert torque is not None
        row = page().text.split("smallest detectable")[1].split("Probability:")[0]
        assert f"torque = {torque:.2f} ±" in row
        assert f"torque = {least:.2g} N m" in row

    def test_explanation_is_complete(self) -> None:
        assert " ".join(found().findings[0].explanation.split()) in page().text

    def test_parameters_stand_beside_their_cad_values(self) -> None:
        row = page().text.split("known before (CAD)")[1].split("one standard deviation")[0]
        assert "inertia kg m^2 1450 ± 200" in row
        assert "gravity_stiffness N m/rad 12600 ± 1800" in row
        assert "coulomb_friction.torque N m" in row

    def test_untested_effects_are_listed_with_their_reasons(self) -> None:
        rest = page().text.split("What was not tested")[1]
        reason = (found().left_out or {})["gyro_bias"].removeprefix("effect gyro_bias: ")
        assert reason
        assert f"gyro_bias {reason}" in rest
        listed = {name: size.replace(HARD_SPACE, " ") for name, _, size in detectables(found())}
        assert listed.keys() == (found().minimum_detectable or {}).keys()
        assert all(name in rest and size in rest for name, size in listed.items())


def test_gist_names_effect_size_and_the_fall_of_the_error() -> None:
    text, (finding, *_) = gist(found()), found().findings
    torque = finding.parameters["coulomb_friction.torque"]
    assert text.startswith("The model lacks coulomb_friction")
    assert f"(torque = {with_error(torque.value or 0.0, torque.std, 'N m')}): with it, the normalised" in text
    assert f"from {found().innovation_ratio_before:#.3g} to {found().innovation_ratio_after:#.3g}" in text
    assert finding.relevance is not None
    assert text.endswith(f"and the error energy 0.5 s ahead by {percent(finding.relevance.ahead)}.")


def test_gist_of_an_adequate_model_is_its_headline() -> None:
    text = gist(Diagnosis(Verdict.ADEQUATE, ""))
    assert text == "The model explains these recordings to within their noise."


class TestDisturbance:
    def test_disturbance_is_stated_before_and_after(self) -> None:
        section = page().text.split("What shakes the vehicle")[1].split("Which effect")[0]
        (after,) = found().disturbance
        (before,) = disturbances(found().steps[0].fit)
        assert str(after) in section
        assert str(before) in section
        assert before.std > after.std

    def test_error_of_the_best_possible_prediction_is_stated(self) -> None:
        limit = found().prediction_limit
        assert limit is not None
        error = np.degrees(limit.disturbed["roll"])
        assert f"The best possible prediction 0.5 s ahead has an error of {error:.2g} deg RMS in roll" in page().text

    def test_share_of_the_error_stands_beside_each_finding(self) -> None:
        relevance = found().findings[0].relevance
        assert relevance is not None
        section = page().text.split("Which effect")[1].split("probability")[0]
        assert "share of the error0.5 s ahead" in section
        assert percent(relevance.ahead) in section

    def test_negligible_effect_is_listed_apart_and_headline_says_so(self) -> None:
        shown_page = Page(write_report(of_little_matter(), MODEL, [record()], support=VEHICLE.support))
        assert "Negligible effect: nothing is missing that matters" in shown_page.text
        assert "may be left out" in headline(of_little_matter()).next_step
        above, below = shown_page.text.split("as good without them.")
        assert found().findings[0].definition.title in below
        assert "Its nearest neighbour" not in above

    def test_untried_effects_are_listed_with_the_remedy(self) -> None:
        hurried = replace(found(), untried=("hysteresis", "further effects"))
        text = write_report(hurried, MODEL, [record()], support=VEHICLE.support, seconds=60.0)
        assert "Left untried for want of time (60 s): hysteresis; further effects. Remedy: --budget 300." in text
        assert "Left untried" not in page().text

    def test_headline_of_an_adequate_model_states_a_significant_disturbance(self) -> None:
        (shaken,) = found().disturbance
        line = headline(replace(found(), verdict=Verdict.ADEQUATE, disturbance=(replace(shaken, shown=True),)))
        assert line.text.endswith(f"to within their noise and a random disturbance of {rms(shaken)}")
        line = headline(replace(found(), verdict=Verdict.ADEQUATE, disturbance=(replace(shaken, shown=False),)))
        assert line.text.endswith("to within their noise")


class TestOtherVerdicts:
    def test_adequate_model_is_shown_once_with_the_nearest_effects(self) -> None:
        alone = replace(
            found(), verdict=Verdict.ADEQUATE, reason="nothing is left", findings=(), steps=found().steps[:1]
        )
        shown_page = Page(write_report(alone, MODEL, [record()], support=VEHICLE.support))
        assert "Adequate: the model explains these recordings" in shown_page.text
        assert "fitted model, 0.5 s ahead" in shown_page.text
        assert "before, 0.5 s ahead" not in shown_page.text
        assert "These came nearest" in shown_page.text
        assert "Nothing is left." in shown_page.text
        assert shown_page.figures == list(FIGURES)

    def test_insufficient_data_need_no_figures(self) -> None:
        insufficient = Diagnosis(Verdict.INSUFFICIENT_DATA, "roll <of> the vehicle: never moves. Remedy: excite it.")
        text = write_report(insufficient, MODEL, [record()], support=VEHICLE.support, provenance=PROVENANCE)
        shown_page = Page(text)
        assert shown_page.figures == []
        assert "Insufficient data: these recordings cannot show" in shown_page.text
        assert "Roll <of> the vehicle: never moves. Remedy: excite it." in shown_page.text
        assert HASH in shown_page.text
        assert "Parameters" not in shown_page.text

    def test_figures_that_cannot_be_drawn_are_explained(self) -> None:
        # 2 s contain no segment for a comparison: the vehicle is still getting up.
        early = record().timestamp_ns < record().timestamp_ns[0] + 2_000_000_000
        short = replace(
            record(),
            timestamp_ns=record().timestamp_ns[early],
            values={name: column[early] for name, column in record().values.items()},
        )
        shown_page = Page(write_report(found(), MODEL, [short], support=VEHICLE.support))
        assert "The models could not be run over the recordings" in shown_page.text
        assert shown_page.figures == [FIGURES[-1]]

    @pytest.mark.parametrize("verdict", list(Verdict))
    def test_each_verdict_has_a_line_and_a_next_step_of_one_sentence(self, verdict: Verdict) -> None:
        line = headline(replace(found(), verdict=verdict))
        assert line.kind == verdict.value
        assert line.text
        assert line.next_step.endswith(".")
        assert ". " not in line.next_step

    def test_next_step_is_to_distinguish_tied_effects(self) -> None:
        finding = replace(found().findings[0], tied_with=("viscous_friction",))
        line = headline(replace(found(), findings=(finding,)))
        assert "coulomb_friction or viscous_friction" in line.text
        assert "Distinguish coulomb_friction from viscous_friction" in line.next_step

    def test_suggested_experiment_is_the_next_step(self) -> None:
        suggested = {"experiment": "sweep", "text": "60 s of sweep separates a from b"}
        line = headline(replace(found(), suggested_experiment=suggested))
        assert "60 s of sweep separates a from b." in line.next_step


class TestDrawing:
    def test_identical_figures_have_identical_text(self) -> None:
        one, other = (staircase(["as given", "fitted"], [30.0, 1.1]) for _ in range(2))
        assert one == other

    def test_long_curves_are_thinned_at_the_same_samples(self) -> None:
        time = np.arange(100_000.0)
        thin, values = thinned(time, 2.0 * time)
        assert len(thin) <= MOST_POINTS
        assert np.array_equal(values, 2.0 * thin)

    def test_recordings_are_plotted_one_after_the_other(self) -> None:
        # Two parts of one recording, whose gap stays, then another recording.
        assert in_a_row([1.0, 6.0, 2.0], [5.0, 9.0, 4.0]).tolist() == [0.0, 0.0, 7.0]

    def test_angles_are_shown_in_degrees(self) -> None:
        factor, unit = shown("rad/s")
        assert factor == pytest.approx(57.29578)
        assert unit == "deg/s"
        assert shown("N m") == (1.0, "N m")

    def test_very_small_p_value_is_given_as_a_bound(self) -> None:
        assert p_text(1e-9) == "< 1e-6"
        assert p_text(0.0123) == "0.012"
