"""The score test: amplitudes, signs, and calibrated p-values."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy import stats
from virtual_records import multisine

from upright.diagnosis.prepare.candidates import at_frequencies, candidates_for
from upright.diagnosis.prepare.workspace import Workspace, attached
from upright.diagnosis.score.score_test import DETECTABLE, ScoreTest, score_test
from upright.diagnosis.score.whitened import Whitened, project
from upright.estimators.fit.maximum_likelihood import fit
from upright.estimators.identify.run import with_values
from upright.models import library
from upright.models.effects.catalogue import CATALOGUE
from upright.vehicles.file import load
from upright.vehicles.registry import nominal_model

VEHICLE = load("monocab")
MODEL = with_values(
    nominal_model("monocab").remove("static_torque"), VEHICLE.parameters.values, VEHICLE.parameters.deviations
)
FEW = ("static_torque", "coulomb_friction", "viscous_friction", "cubic_stiffness", "periodic_disturbance")


@cache
def clean() -> tuple[Workspace, Whitened]:
    workspace = Workspace.of(MODEL, [multisine()], VEHICLE.support, FEW)
    return workspace, Whitened.of(fit(workspace.problem(MODEL)))


def scored(innovations: Whitened) -> ScoreTest:
    workspace, _ = clean()
    return score_test(innovations, lambda group: workspace.problem(attached(MODEL, group)), workspace.candidates)


def white(seed: int) -> Whitened:
    """The innovations of a correct model."""
    _, innovations = clean()
    noise = np.random.default_rng(seed).standard_normal((len(innovations.residual), 1))
    return replace(innovations, residual=project(noise, innovations.nuisance)[:, 0])


def planted(name: str, size: float) -> Whitened:
    """White innovations plus the contribution of `size` of the first amplitude of `name`, to first order."""
    workspace, innovations = clean()
    candidate = next(each for each in workspace.candidates if each.name == name)
    task = workspace.problem(attached(MODEL, [candidate]))
    direction = innovations.directions(task, [candidate.amplitudes[0]], candidate.variants[0])
    noise = white(seed=1)
    return replace(noise, residual=noise.residual + size * project(direction, innovations.nuisance)[:, 0])


class TestAmplitudes:
    @pytest.mark.parametrize(
        ("name", "size"), [("static_torque", 5.0), ("coulomb_friction", 4.0), ("viscous_friction", 200.0)]
    )
    def test_planted_amplitude_is_estimated_and_ranks_first(self, name: str, size: float) -> None:
        """3.3 standard errors: a correct implementation exceeds them with one seed in a thousand."""
        found = scored(planted(name, size))
        score = found.score(name)
        first = score.candidate.amplitudes[0]
        assert abs(score.sizes[first] - size) < 3.3 * score.standard_errors[first]
        assert score.p_value < 1e-4
        assert found.scores[0].candidate.name == name

    def test_physically_impossible_sign_is_not_significant(self) -> None:
        score = scored(planted("coulomb_friction", -4.0)).score("coulomb_friction")
        assert score.sizes["coulomb_friction.torque"] == 0.0
        assert score.p_value > 0.5

    def test_effect_above_the_detectable_amplitude_is_significant(self) -> None:
        least = scored(clean()[1]).score("viscous_friction").detectable
        assert scored(planted("viscous_friction", 1.5 * least)).score("viscous_friction").p_single < 1e-3

    def test_step_is_detectable_by_what_exceeds_a_constant_torque(self) -> None:
        """Four times the detectable step exceeds a constant torque by 4 x 4.66 standard deviations, whose square
        scatters by twice that: 3.3 standard deviations to either side. This holds at the best change point only."""
        task, innovations = clean()
        workspace = Workspace.of(MODEL, task.recordings, VEHICLE.support, ("static_torque", "torque_step"))
        step = next(each for each in workspace.candidates if each.name == "torque_step")

        def look(innovations: Whitened) -> ScoreTest:
            return score_test(
                innovations, lambda group: workspace.problem(attached(MODEL, group)), workspace.candidates
            )

        least = look(white(seed=1)).score("torque_step").detectable
        beyond = []
        for shape in step.variants:
            moved = innovations.directions(workspace.problem(attached(MODEL, [step])), step.amplitudes, shape)
            noise = white(seed=1)
            seen = noise.residual + 4.0 * least * project(moved, innovations.nuisance)[:, 0]
            found = look(replace(noise, residual=seen))
            one, other = (found.score(name) for name in ("torque_step", "static_torque"))
            # Without the inflation of the variance, which the remainder of the step causes.
            beyond.append(one.statistic * one.inflation - other.statistic * other.inflation)
        away = 4.0 * DETECTABLE
        assert max(beyond) == pytest.approx(away**2, abs=3.3 * 2.0 * away)

    def test_detectable_amplitude_is_that_of_the_usual_shape(self) -> None:
        """Stribeck friction that fades in fast motion is detectable at less than half the amplitude: another effect."""
        _, innovations = clean()
        workspace = Workspace.of(MODEL, [multisine()], VEHICLE.support, ("coulomb_friction", "stribeck_friction"))
        coulomb, stribeck = workspace.candidates

        def least(*variants: Mapping[str, float]) -> float:
            both = [coulomb, replace(stribeck, variants=variants)]
            found = score_test(innovations, lambda group: workspace.problem(attached(MODEL, group)), both)
            return found.score("stribeck_friction").detectable

        usual, other = least(stribeck.variants[0]), [least(each) for each in stribeck.variants[1:]]
        assert least(*stribeck.variants) == pytest.approx(usual)
        assert min(other) < 0.6 * usual

    def test_asymmetric_friction_is_detectable_by_what_exceeds_coulomb_friction(self) -> None:
        """Friction in one direction is half Coulomb friction, so the remainder is harder to detect than the whole."""
        task, innovations = clean()
        names = ("coulomb_friction", "asymmetric_friction")
        workspace = Workspace.of(MODEL, task.recordings, VEHICLE.support, names)
        found = score_test(innovations, lambda group: workspace.problem(attached(MODEL, group)), workspace.candidates)
        one = found.bases["coulomb_friction"]
        moved = project(
            innovations.directions(
                workspace.problem(attached(MODEL, [found.score("asymmetric_friction").candidate])),
                ["asymmetric_friction.torque_forward"],
                {},
            ),
            innovations.nuisance,
        )
        left = np.linalg.norm(moved - one @ (one.T @ moved))
        score = found.score("asymmetric_friction")
        assert score.detectable == pytest.approx(DETECTABLE * np.sqrt(score.inflation) / left, rel=1e-6)
        assert left < 0.8 * np.linalg.norm(moved)


class TestPairs:
    NAMES = ("gimbal_imbalance", "load_dependent_friction", "static_torque", "viscous_friction")

    def workspace(self) -> Workspace:
        return Workspace.of(MODEL, clean()[0].recordings, VEHICLE.support, self.NAMES)

    def unit(self, name: str) -> np.ndarray:
        """What an effect of one standard error does to the innovations."""
        (candidate,) = (each for each in self.workspace().candidates if each.name == name)
        innovations = clean()[1]
        with_it = self.workspace().problem(attached(MODEL, [candidate]))
        moved = project(innovations.directions(with_it, candidate.amplitudes[:1], {}), innovations.nuisance)[:, 0]
        return moved / np.linalg.norm(moved)

    def along(self) -> float:
        """How far the first two effects do the same, -1 to 1."""
        one, other = self.NAMES[:2]
        return float(self.unit(one) @ self.unit(other))

    def look(self, sizes: Mapping[str, float]) -> ScoreTest:
        """The score test of white innovations plus `sizes` of effects, in the standard errors that each has alone."""
        workspace, noise = self.workspace(), white(seed=5)
        seen = noise.residual + sum(size * self.unit(name) for name, size in sizes.items())
        return score_test(
            replace(noise, residual=seen),
            lambda group: workspace.problem(attached(MODEL, group)),
            workspace.candidates,
        )

    def test_two_effects_that_cancel_each_other_are_significant_as_a_pair(self) -> None:
        one, other = self.NAMES[:2]
        # One effect partly cancels the other.
        assert abs(self.along()) > 0.5
        found = self.look({one: -8.0 * np.sign(self.along()), other: 8.0})
        assert {each.name for each in found.pairs[0].candidates} == {one, other}
        alone = min(score.p_value for score in found.scores if score.candidate.name in (one, other))
        assert found.pairs[0].p_value < 1e-3 * alone

    def test_pair_with_physically_impossible_signs_is_excluded(self) -> None:
        one, other = self.NAMES[:2]
        pairs = self.look({one: 8.0 * np.sign(self.along()), other: -8.0}).pairs
        assert all({each.name for each in pair.candidates} != {one, other} for pair in pairs)

    def test_white_noise_has_no_significant_pair(self) -> None:
        assert all(pair.p_value > 0.01 for pair in self.look({}).pairs)


class TestProbabilities:
    def test_p_values_are_uniform_if_nothing_is_missing(self) -> None:
        """White noise in place of the innovations, 60 seeds: the smallest p-value is uniform from 0 to 1 by
        the Kolmogorov-Smirnov test, at a level of 1 % (how often it rejects a correct implementation)."""
        found = [min(score.p_value for score in scored(white(seed)).scores) for seed in range(60)]
        assert stats.kstest(found, "uniform").pvalue > 0.01

    def test_clean_record_has_no_significant_effect(self) -> None:
        assert min(score.p_value for score in scored(clean()[1]).scores) > 0.01

    def test_frequencies_picked_from_the_data_are_counted_if_within_bounds(self) -> None:
        workspace, _ = clean()
        line = next(each for each in workspace.candidates if each.name == "periodic_disturbance")
        (further,) = at_frequencies([line], [2.2, 1e6], among=4000)
        assert [each["periodic_disturbance.frequency"] for each in further.variants[-1:]] == [2.2]
        assert further.picked == 1


class TestSimilarity:
    def test_similarity_of_an_effect_to_itself_is_one_and_it_is_symmetric(self) -> None:
        found = scored(clean()[1])
        assert found.similarity("coulomb_friction", "coulomb_friction") == pytest.approx(1.0)
        one = found.similarity("coulomb_friction", "viscous_friction")
        assert one == pytest.approx(found.similarity("viscous_friction", "coulomb_friction"))
        assert 0.2 < one < 0.99


class TestCandidates:
    def test_every_effect_is_a_candidate_or_left_out_with_a_reason(self) -> None:
        found, left_out = candidates_for(MODEL, [multisine()])
        assert {each.effect.name for each in found} | set(left_out) == set(CATALOGUE)
        assert "input_delay" in {each.name for each in found}, "what passes on a measured motion may be late"

    def test_effect_whose_channel_is_not_recorded_is_left_out_with_the_reason(self) -> None:
        whole = multisine()
        kept = type(whole.channels)(channel for channel in whole.channels if channel.name != "precession")
        recording = replace(whole, channels=kept, values={name: whole.values[name] for name in kept.names})
        found, left_out = candidates_for(MODEL, [recording])
        assert "gimbal_imbalance" not in {each.name for each in found}
        assert "precession" in left_out["gimbal_imbalance"]

    def test_effect_that_the_model_already_has_is_no_candidate(self) -> None:
        found, _ = candidates_for(MODEL.add("coulomb_friction"), [multisine()])
        assert "coulomb_friction" not in {each.name for each in found}


def test_every_place_that_can_have_an_effect_is_a_candidate() -> None:
    """The robot has a joint for the tilt, one for each wheel, and one for the floor."""
    robot = library.get("twsbr")
    found, left_out = candidates_for(robot, (), ["coulomb_friction"])
    assert [each.name for each in found] == [
        "coulomb_friction",
        *(f"coulomb_friction@{joint.name}" for joint in robot.joints[1:]),
    ]
    assert [each.attached.at for each in found] == [joint.name for joint in robot.joints]
    assert not left_out
    extended = robot.add("coulomb_friction", robot.joints[1].name)
    assert found[1].name not in {each.name for each in candidates_for(extended, (), ["coulomb_friction"])[0]}
    both = attached(robot, found[:2])
    assert [each.at for each in both.effects] == [joint.name for joint in robot.joints[:2]]
