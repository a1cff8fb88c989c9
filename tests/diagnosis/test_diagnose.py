"""From recordings to a verdict: the effects hidden in the virtual vehicle are found, and no others."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from thorough import of_many
from virtual_records import multisine

from upright.diagnosis.diagnose import Diagnosis, Verdict, diagnose
from upright.diagnosis.explain import explain
from upright.estimators.identify.run import with_values
from upright.models.effect import Effect, EffectParameter, Family
from upright.models.parts import Place
from upright.service.virtual.run import record
from upright.simulation.monocab.hidden import HIDDEN
from upright.telemetry.recording import Recording
from upright.vehicles.file import load
from upright.vehicles.registry import nominal_model

VEHICLE = load("monocab")
MODEL = with_values(
    nominal_model("monocab").remove("static_torque"), VEHICLE.parameters.values, VEHICLE.parameters.deviations
)


@cache
def found_in(*hide: str) -> Diagnosis:
    return diagnose(MODEL, [multisine(*hide)], support=VEHICLE.support)


class TestNothingMissing:
    def test_clean_record_is_adequate(self) -> None:
        found = found_in()
        assert found.verdict is Verdict.ADEQUATE
        assert found.findings == ()
        assert found.innovation_ratio_after == pytest.approx(1.0, abs=0.1)  # the tolerance of adequacy itself

    def test_minimum_detectable_effects_are_reported(self) -> None:
        found = found_in()
        assert found.minimum_detectable is not None
        assert found.minimum_detectable["coulomb_friction"] < 0.1 * HIDDEN["coulomb_friction"].size
        assert all(size > 0.0 for size in found.minimum_detectable.values())
        assert found.minimum_detectable["input_delay"] < 0.02


class TestOneEffect:
    @pytest.mark.parametrize(
        ("hide", "name", "parameter", "within"),
        of_many(
            [
                # The plant's friction has bristles, tanh does not: a tenth of the amplitude.
                ("coulomb_friction", "coulomb_friction", "torque", 0.1),
                ("viscous_friction", "viscous_friction", "coefficient", 0.1),
            ],
            ("viscous_friction", "viscous_friction", "coefficient", 0.1),
        ),
    )
    def test_is_named_with_its_amplitude(self, hide: str, name: str, parameter: str, within: float) -> None:
        found = found_in(hide)
        assert found.verdict is Verdict.MISSING_EFFECT
        assert found.findings[0].effect == name
        assert len(found.findings[0].tied_with) <= 1
        size = found.findings[0].parameters[f"{name}.{parameter}"].value
        assert size == pytest.approx(HIDDEN[hide].size, rel=within)

    def test_error_falls_to_the_floor_and_held_out_data_confirm_the_effect(self) -> None:
        found = found_in("viscous_friction")
        before, after = found.innovation_ratio_before, found.innovation_ratio_after
        assert before is not None
        assert after is not None
        assert before > 1.5
        assert after == pytest.approx(1.0, abs=0.1)
        held_out = found.findings[0].held_out
        assert held_out is not None
        assert held_out.gain > 2.0 * held_out.std

    def test_periodic_disturbance_is_found_at_its_frequency(self) -> None:
        finding = found_in("periodic_disturbance").findings[0]
        assert finding.effect == "periodic_disturbance"
        assert finding.parameters["periodic_disturbance.frequency"].value == pytest.approx(1.3, abs=0.01)

    def test_indistinguishable_effects_are_tied(self) -> None:
        finding = found_in("static_torque").findings[0]
        assert {finding.effect, *finding.tied_with} >= {"static_torque", "sensor_offset"}
        assert "Tied with" in finding.explanation

    def test_explanation_has_equation_unit_uncertainty_and_detection_limit(self) -> None:
        text = found_in("viscous_friction").findings[0].explanation
        for part in ("coefficient rate", "N m s/rad", " ± ", "would have shown"):
            assert part in text

    def test_limit_above_what_was_found_is_not_stated(self) -> None:
        finding = found_in("viscous_friction").findings[0]
        assert finding.score_test is not None
        score = next(each for each in finding.score_test.scores if each.candidate.name == finding.effect)
        assert "would have shown" in explain(finding, score)
        assert "would have shown" not in explain(finding, replace(score, detectable=1e3 * score.detectable))


class TestTwoEffects:
    def test_both_are_found(self) -> None:
        found = found_in("viscous_friction", "periodic_disturbance")
        assert {each.effect for each in found.findings} == {"viscous_friction", "periodic_disturbance"}


class TestOwnEffect:
    def test_is_ranked_with_those_of_the_catalogue(self) -> None:
        own = Effect(
            name="wheel_drag",
            family=Family.SPEED_DRAG,
            title="drag of a wheel",
            place=Place.JOINT,
            equation="F = -drag rate",
            parameters=(EffectParameter("drag", "{force} s/{coordinate}", "of it", amplitude=True, scale="100"),),
            force="-drag * rate",
            signature="A force against the rate.",
            confused_with=("viscous_friction",),
            separated_by="Nothing: it is viscous friction by another name.",
        )
        found = diagnose(
            MODEL, [multisine("viscous_friction")], support=VEHICLE.support, candidates=["coulomb_friction", own]
        )
        assert found.findings[0].effect == "wheel_drag"


def changed(recording: Recording, **channels: np.ndarray) -> Recording:
    return replace(recording, values={**recording.values, **channels})


class TestInsufficientData:
    def insufficient(self, recording: Recording) -> str:
        found = diagnose(MODEL, [recording], support=VEHICLE.support)
        assert found.verdict is Verdict.INSUFFICIENT_DATA
        assert found.findings == ()
        assert found.to_json()["minimum_detectable"] == {}
        return found.reason

    def test_too_short(self) -> None:
        """The MONOCAB needs 8 s, twenty of its natural times."""
        assert "Remedy: record 8 s or more" in self.insufficient(multisine().between(0.0, 8.0))

    def test_no_excitation(self) -> None:
        assert "noise" in self.insufficient(record("monocab", "hold", seed=9))

    def test_single_sine(self) -> None:
        whole = multisine()
        time = whole.time - whole.time[0]
        sine = {"roll": 0.01 * np.sin(6.0 * time), "roll_rate": 0.06 * np.cos(6.0 * time)}
        assert "single sine" in self.insufficient(changed(whole, **sine))

    def test_saturation(self) -> None:
        rate = np.clip(multisine()["roll_rate"], -0.03, 0.03)
        assert "roll_rate" in self.insufficient(changed(multisine(), roll_rate=rate))

    def test_degrees_instead_of_radians(self) -> None:
        assert "degrees" in self.insufficient(changed(multisine(), roll_rate=np.degrees(multisine()["roll_rate"])))

    def test_degrees_instead_of_radians_beyond_the_supports(self) -> None:
        """A run so quiet that its degrees could be radians: the vehicle seems to have hardly left its supports."""
        whole = multisine().between(10.0)
        angle, rate = (0.2 * np.degrees(whole[name]) for name in ("roll", "roll_rate"))
        assert "convert degrees to rad" in self.insufficient(changed(whole, roll=angle, roll_rate=rate))

    def test_sensor_slower_than_the_sampling_rate(self) -> None:
        """A camera: the samples repeat its last value until the next frame."""
        whole = multisine()
        reason = self.insufficient(changed(whole, roll=whole["roll"][np.arange(len(whole)) // 3 * 3]))
        assert "roll: holds each value for 3 samples" in reason
        assert "Remedy: record one sample per frame" in reason

    def test_swapped_channels(self) -> None:
        whole = multisine()
        swapped = changed(whole, roll_rate=whole["precession_rate"], precession_rate=whole["roll_rate"])
        assert "roll_rate" in self.insufficient(swapped)


class TestDocument:
    def test_has_the_keys_that_scripts_read(self) -> None:
        document = found_in("viscous_friction").to_json()
        assert set(document) >= {
            "adequate",
            "verdict",
            "findings",
            "minimum_detectable",
            "suggested_experiment",
            "innovation_ratio_before",
            "innovation_ratio_after",
            "disturbance",
            "prediction_limit",
            "events",
            "untried",
        }
        assert set(document["findings"][0]) == {
            "effect",
            "family",
            "parameters",
            "probability",
            "p_value",
            "held_out_error_closed_percent",
            "tied_with",
            "made_of",
            "relevance",
            "explanation",
        }

    def test_progress_names_the_effects_whose_models_are_compiled(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        """As on a computer on which no model was compiled yet."""
        monkeypatch.setenv("UPRIGHT_CACHE", str(tmp_path))
        monkeypatch.setattr("upright.models.compiler.kernel._loaded", {})
        messages: list[str] = []
        friction = multisine("coulomb_friction")
        few = ("coulomb_friction", "viscous_friction")
        diagnose(
            MODEL, [friction], support=VEHICLE.support, candidates=few, progress=lambda text, _: messages.append(text)
        )
        compiled = [text for text in messages if ": compiling with " in text]
        assert any(text.endswith("with dry friction of constant magnitude") for text in compiled)

    def test_progress_never_decreases(self) -> None:
        shares: list[float] = []
        diagnose(MODEL, [multisine()], support=VEHICLE.support, progress=lambda text, share: shares.append(share))
        assert shares == sorted(shares)
        assert shares[0] >= 0.0
        assert shares[-1] <= 1.0
