"""Free decays: friction that is clearly visible is named, whether by an encoder or by a camera, at 50 to 500 Hz."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from benchmarks.free_decays import Body, pushed
from upright.diagnosis.diagnose import Diagnosis, Verdict, diagnose
from upright.diagnosis.fits.input_noise import not_acting
from upright.diagnosis.prepare.ready import ready
from upright.diagnosis.report.sentences import disturbance_sentences
from upright.estimators.data.quantised import step_of
from upright.estimators.data.resting import without_rests
from upright.estimators.fit import innovations
from upright.estimators.fit.likelihood import Likelihood
from upright.estimators.fit.maximum_likelihood import fit
from upright.estimators.fit.problem import Problem, problem, typical_motion
from upright.estimators.fit.random.input_noise import input_noise
from upright.estimators.fit.random.sensor_errors import InputError
from upright.models.file.model_file import load_model
from upright.models.random.input_noise import noisy_inputs
from upright.telemetry.recording import Recording
from upright.telemetry.storage import load

pytestmark = [pytest.mark.timeout(300), pytest.mark.patient]


def sizes(found: Diagnosis) -> dict[str, float | None]:
    return {name: each.value for finding in found.findings for name, each in finding.parameters.items()}


def test_dry_and_viscous_friction_of_a_pendulum_with_an_encoder_are_named() -> None:
    body = Body(dry=0.012, viscous=0.001)
    found = diagnose(body.model(1e-3, 0.3), [body.by_encoder(4096)])
    assert found.verdict is Verdict.MISSING_EFFECT, found.reason
    assert [each.effect for each in found.findings] == ["coulomb_friction", "viscous_friction"]
    assert sizes(found)["coulomb_friction.torque"] == pytest.approx(0.012, rel=0.05)
    assert sizes(found)["viscous_friction.coefficient"] == pytest.approx(0.001, rel=0.1)


@pytest.mark.parametrize(
    ("names", "body"),
    [
        (["coulomb_friction", "viscous_friction"], Body(dry=0.01, viscous=0.0005, begin=1.0, rate=500.0)),
        (["viscous_friction"], Body(dry=0.0003, viscous=0.004, begin=1.0, rate=500.0)),
    ],
)
def test_friction_of_a_pendulum_is_named_from_a_camera_with_delay_and_jitter(names: list[str], body: Body) -> None:
    """Held-out data used to reject the right effect, because they were judged with a noise that their own fit excludes,
    and an effect that is not identifiable from any part of the record was named instead."""
    record = body.by_camera(noise=2e-3, jitter=2e-3, late=0.015, rate=50.0, seed=3)
    found = diagnose(body.model(2e-3, 0.3), [record])
    assert found.verdict is Verdict.MISSING_EFFECT, found.reason
    assert [each.effect for each in found.findings] == names
    hidden = {"coulomb_friction.torque": body.dry, "viscous_friction.coefficient": body.viscous}
    for name, size in sizes(found).items():
        assert size == pytest.approx(hidden[name], rel=0.15)


@pytest.mark.thorough
def test_friction_and_current_noise_of_a_passive_motor_are_found() -> None:
    """The model is driven by a measured torque that does not act: the verdict used to be unknown, with a force that is
    correlated with this torque."""
    body = Body(dry=0.012, viscous=0.001)
    found = diagnose(body.model(1e-3, 0.3), [body.by_encoder(4096, torque_noise=0.003, seed=7)])
    assert found.verdict is Verdict.MISSING_EFFECT, found.reason
    assert [each.effect for each in found.findings] == ["coulomb_friction", "viscous_friction"]
    assert sizes(found)["coulomb_friction.torque"] == pytest.approx(0.012, rel=0.05)
    assert sizes(found)["viscous_friction.coefficient"] == pytest.approx(0.001, rel=0.1)
    (error,) = found.sensor_errors
    assert isinstance(error, InputError)
    assert error.std == pytest.approx(0.003, rel=0.05)
    assert abs(error.idle - 1.0) < 3.0 * error.idle_error
    assert "of which" in disturbance_sentences(found)
    assert found.to_json()["sensor_errors"]["torque"]["unit"] == "N m"
    # This noise belongs to the record, not to the machine.
    assert found.revised is not None
    assert found.revised.joints[0].load == body.model(1e-3, 0.3).joints[0].load
    assert not noisy_inputs(found.revised)


class TestInputNoise:
    def test_std_is_estimated_beside_a_random_walk(self) -> None:
        random = np.random.default_rng(4)
        walk = np.cumsum(0.02 * random.standard_normal(5000))
        found = input_noise(driven_by(walk + 0.1 * random.standard_normal(5000)), "torque")
        assert found is not None
        assert found.std == pytest.approx(0.1, rel=0.05)
        # The gain of the steady-state filter solves k^2 / (1 - k) = (0.02 / 0.1)^2.
        assert found.time == pytest.approx(-0.005 / np.log1p(-0.181), rel=0.15)

    @pytest.mark.parametrize("kind", ["sine", "steps", "walk"])
    def test_signals_without_added_noise_have_none(self, kind: str) -> None:
        time, random = np.arange(5000) / 200.0, np.random.default_rng(5)
        steps = np.repeat(random.standard_normal(50), 100)
        walk = np.cumsum(random.standard_normal(5000))
        readings = {"sine": np.sin(2.0 * np.pi * 0.7 * time), "steps": steps, "walk": walk}
        assert input_noise(driven_by(readings[kind]), "torque") is None

    def test_random_torque_that_acts_is_not_noise(self) -> None:
        """The readings look like noise, but the motion of the body shows that all of it acts."""
        table = 0.05 * np.random.default_rng(3).standard_normal(20000)
        body = Body(viscous=0.001, begin=0.5, span=20.0, torque=lambda time: float(table[round(time * 200.0)]))
        record = body.by_encoder(4096)
        model = ready(body.model(1e-3, 0.3).add("viscous_friction"), [record])
        task = problem(model, [record])
        assert input_noise(task, "torque") is not None
        assert not not_acting(fit(task))


def driven_by(readings: NDArray[np.float64]) -> Problem:
    """A swinging body whose torque sensor gives these `readings`, at 200 Hz."""
    body = Body(span=len(readings) / 200.0)
    record = body.by_encoder(4096)
    record = Recording(record.channels, record.timestamp_ns, {**record.values, "torque": readings})
    return problem(body.model(1e-3, 0.3), [record])


@pytest.mark.thorough
def test_viscous_friction_of_an_arm_without_gravity_is_named() -> None:
    arm = Body(inertia=0.005, stiffness=0.0, dry=1e-4, viscous=0.0015, begin=0.0, rate=500.0, torque=pushed)
    found = diagnose(arm.model(2e-3, 0.05), [arm.by_encoder(2048)])
    assert found.verdict is Verdict.MISSING_EFFECT, found.reason
    assert found.findings[0].effect == "viscous_friction"
    assert sizes(found)["viscous_friction.coefficient"] == pytest.approx(0.0015, rel=0.02)


def test_measured_swing_has_dry_friction(measured_data: Path) -> None:
    """Its peaks and its authors give 0.2 to 0.3 N m, a simulation fitted without a predictor 0.18."""
    folder = measured_data.parent / "field" / "swing"
    if not folder.is_dir():
        pytest.skip("the measured swing is not there")
    found = diagnose(load_model(folder / "pendulum.toml"), [load(folder / "run.csv").between(11.8)])
    assert found.verdict is Verdict.MISSING_EFFECT, found.reason
    (finding,) = found.findings
    assert finding.family == "dry_friction"
    assert finding.made_of is not None
    assert finding.made_of.parameters["coulomb_friction.torque"].value == pytest.approx(0.2, abs=0.03)


class TestQuantisation:
    def test_step_is_found_only_in_quantised_signals(self) -> None:
        random = np.random.default_rng(1)
        smooth = np.cumsum(random.standard_normal(1000))
        assert step_of(np.round(smooth / 0.3) * 0.3) == pytest.approx(0.3, rel=1e-6)
        assert step_of(smooth) == 0.0
        assert step_of(np.full(1000, 2.0)) == 0.0
        # Rounding in a text file quantises to the last digit.
        assert step_of(np.round(smooth, 4)) == pytest.approx(1e-4, rel=1e-3)

    def test_quantised_output_has_the_noise_of_a_quantiser(self) -> None:
        body = Body(dry=0.012, span=10.0)
        known = ready(body.model(1e-4, 0.3), [body.by_encoder(4096)]).outputs[0]
        assert known.counted
        assert known.noise == pytest.approx(2.0 * np.pi / 4096 / np.sqrt(12.0), rel=1e-3)
        seen = ready(body.model(1e-4, 0.3), [body.by_camera(noise=2e-3, jitter=0.0, late=0.0, rate=50.0, seed=1)])
        assert not seen.outputs[0].counted

    def test_rest_is_left_out_and_turning_points_are_not(self) -> None:
        body = Body(dry=0.03, span=20.0)
        record = body.by_encoder(4096)
        model = ready(body.model(1e-4, 0.3), [record])
        (cut,) = without_rests(model, [record])
        moves = np.flatnonzero(np.diff(record["position"])) + 1
        assert np.isfinite(cut["position"][: moves[-1] + 1]).all()
        assert np.isnan(cut["position"][moves[-1] + 1 :]).all()

    def test_encoder_at_rest_has_at_least_its_quantisation_noise(self) -> None:
        body = Body(dry=0.03, span=20.0)
        record = body.by_encoder(4096)
        model = ready(body.model(1e-4, 0.3).add("coulomb_friction"), [record])
        task = problem(model, [record])
        likelihood = Likelihood.of(task, np.array([parameter.std for parameter in task.parameters]))
        values = np.where([p.name == "coulomb_friction.torque" for p in task.parameters], 0.03, task.start)
        seen = likelihood(np.concatenate((values, np.zeros(likelihood.noise.size))), [*task.own_start, np.zeros(0)])
        assert seen is not None
        assert seen.covariance[0, 0] >= model.outputs[0].noise ** 2


def test_typical_rate_is_found_for_an_output_with_a_name_of_its_own() -> None:
    body = Body(span=10.0)
    record = body.by_encoder(4096)
    task = problem(body.model(1e-4, 0.3), [record])
    time, angle = body.course()
    assert typical_motion(task.model, task.segments)[1] == pytest.approx(
        np.sqrt(np.mean(np.gradient(angle, time) ** 2)), rel=0.02
    )


def test_covariance_has_converged_only_when_that_of_each_state_has() -> None:
    """A disturbance of 100 N m that decays within two samples, beside an angle of 1e-5 rad that drifts slowly."""
    transition, known, process = np.diag([0.6, 0.99995]), np.diag([1e-4, 1e10]), np.diag([1e4, 1e-18])
    both = innovations._doubled(transition, known, process)
    alone = innovations._doubled(transition[1:, 1:], known[1:, 1:], process[1:, 1:])
    assert both is not None
    assert alone is not None
    assert both[1, 1] / alone[0, 0] == pytest.approx(1.0, rel=1e-6)
