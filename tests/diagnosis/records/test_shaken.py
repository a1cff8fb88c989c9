"""The random disturbance in fits and in a diagnosis: it is not an effect that the model of the vehicle lacks."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import binom
from shaken_plant import Shaken
from thorough import of_many

from upright.diagnosis.diagnose import Diagnosis, Verdict, diagnose
from upright.diagnosis.lack_of_fit.events import LEVEL, _best, _by_chance
from upright.diagnosis.prediction.compare import compare
from upright.diagnosis.prepare.ready import ready, unready
from upright.estimators.budget import Budget, OutOfTime
from upright.estimators.fit.innovations import NoiseModel
from upright.estimators.fit.likelihood import Likelihood
from upright.estimators.fit.maximum_likelihood import MUCH, Begin, Fit, fit, noise_of
from upright.estimators.fit.problem import Problem, problem
from upright.estimators.fit.random.disturbance import disturbances
from upright.estimators.identify.run import with_values
from upright.estimators.methods.prediction_error import prediction_error
from upright.estimators.numbers import with_error
from upright.models.effect import Effect, EffectParameter, EffectState, Family
from upright.models.library.axis import axis
from upright.models.model import Model
from upright.models.parts import Disturbance, Place, State
from upright.models.random.disturbance import disturbed, undisturbed
from upright.telemetry.channels import Channel, ChannelTable
from upright.telemetry.recording import Recording
from upright.telemetry.storage import load as load_recording
from upright.vehicles.file import load
from upright.vehicles.registry import nominal_model

pytestmark = pytest.mark.patient

VEHICLE = load("monocab")
NOMINAL = with_values(nominal_model("monocab"), VEHICLE.parameters.values, VEHICLE.parameters.deviations).remove(
    "static_torque"
)


def _task(record: Recording, model: Model = NOMINAL) -> Problem:
    return problem(ready(model, [record]), [record], support=VEHICLE.support)


@pytest.fixture(scope="module")
def shaken() -> Recording:
    return Shaken().record(1)


@pytest.fixture(scope="module")
def fitted(shaken: Recording) -> Fit:
    return fit(_task(shaken))


class TestModel:
    def test_every_joint_gets_a_disturbance(self, shaken: Recording) -> None:
        model = disturbed(NOMINAL, [shaken])
        assert [state.name for state in model.base_states if state.correlation_time] == ["disturbance_roll"]
        assert model.parameter("disturbance_roll_time").upper == pytest.approx(3.0, rel=0.01)  # a tenth of the record
        assert undisturbed(NOMINAL, model).base_parameters == NOMINAL.base_parameters

    def test_disturbance_is_added_once(self, shaken: Recording) -> None:
        once = disturbed(NOMINAL, [shaken])
        assert disturbed(once, [shaken]) == once

    def test_disturbance_can_be_switched_off_and_stated(self, shaken: Recording) -> None:
        (joint,) = NOMINAL.joints
        off = replace(NOMINAL, joints=(replace(joint, disturbance=None),))
        assert disturbed(off, [shaken]) == off
        stated = replace(NOMINAL, joints=(replace(joint, disturbance=Disturbance(8.0, 0.3, known=True)),))
        (found,) = disturbances(fit(_task(shaken, stated)))
        assert (found.std, found.correlation_time, found.known) == (pytest.approx(8.0), 0.3, True)

    def test_model_with_its_own_random_force_gets_no_disturbance(self, shaken: Recording) -> None:
        own = axis(load="wind", process_noise=0.0)
        own = replace(own, base_states=(*own.base_states, State("wind", "N", "-2 * wind", process_noise=1.0)))
        assert disturbed(own, [shaken]) == own

    def test_disturbance_is_removed_from_the_result(self, shaken: Recording) -> None:
        made = ready(NOMINAL, [shaken])
        assert {each.name for each in unready(NOMINAL, made).parameters} == {each.name for each in NOMINAL.parameters}


class TestBias:
    def test_most_likely_correlation_time_is_corrected_upwards(self, fitted: Fit) -> None:
        """Its inverse is reduced by 4 / duration, and the RMS by the root of the factor: the density is kept."""
        (estimate,) = disturbances(fitted)
        likeliest = fitted.values[fitted.problem.kernel.index("disturbance_roll_time")]
        assert estimate.correlation_time is not None
        assert estimate.correlation_time == pytest.approx(1.0 / (1.0 / likeliest - 4.0 / fitted.problem.span), rel=1e-3)
        assert estimate.correlation_time > 1.01 * likeliest


class TestLikelihood:
    @pytest.mark.parametrize("effect", ["", "sensor_offset", "sensor_delay"])
    def test_gradient_agrees_with_finite_differences(self, shaken: Recording, effect: str) -> None:
        """Also with respect to the RMS and the correlation time, which determine the variance of the disturbance at the
        start, and to errors of sensors, which determine how far the initial state is from their readings."""
        task = _task(shaken.between(0.0, 4.0), NOMINAL.add(effect) if effect else NOMINAL)
        likelihood = Likelihood.of(task, np.array([parameter.std for parameter in task.parameters]))
        common = np.concatenate((1.02 * task.start, 0.4 * np.cos(np.arange(likelihood.noise.size))))
        scale = np.concatenate((task.scale, np.ones(likelihood.noise.size)))
        own = [part + 0.3 * spread for part, spread in zip(task.own_start, [task.spread], strict=True)]
        seen = likelihood(common, own)
        assert seen is not None
        slope = sum(normal.vector[: len(common)] for normal in seen.normals)
        for place in range(len(common)):
            step = np.zeros(len(common))
            step[place] = 1e-4 * scale[place]
            ends = [likelihood(common + sign * step, own) for sign in (1.0, -1.0)]
            assert all(ends)
            rise = (ends[0].cost - ends[1].cost) / (2.0 * step[place])  # type: ignore[union-attr]
            assert slope[place] == pytest.approx(rise, rel=2e-3, abs=1e-3 / scale[place])

    def test_information_on_the_start_satisfies_its_recursion(self, fitted: Fit) -> None:
        noise, size = NoiseModel.of(fitted.problem), len(fitted.problem.free)
        values, logarithms = fitted.values, fitted.minimum.common[size:]
        transition, output = noise.covariances(values, logarithms)[:2]
        gain = noise.gain(values, logarithms)
        covariance = noise.innovation(values, logarithms, gain)
        assert gain is not None
        assert covariance is not None
        follows = transition - transition @ gain @ output
        steady = noise.steady_state(values, logarithms, fitted.problem.free, fitted.problem.scale)
        assert steady is not None
        found, _ = steady.start_information()
        total = output.T @ np.linalg.solve(covariance, output) + follows.T @ found @ follows
        assert found == pytest.approx(total, rel=1e-6, abs=1e-9 * float(np.max(total)))

    @pytest.mark.parametrize("seed", [3, 4])
    def test_fit_of_a_weak_fast_disturbance_ends_at_one_optimum_from_all_starts(self, seed: int) -> None:
        """Maximised jointly with the initial state, the likelihood ended at no disturbance from one of the starts."""
        task = _task(Shaken(rms=3.0, correlation_time=0.06).record(seed))
        ends = [
            fit(task, begin=Begin({}, noise_of(task, shaken=shaken, white=white)))
            for shaken, white in ((0.0, 0.0), (MUCH, -MUCH), (-MUCH, MUCH))
        ]
        assert all(end.minimum.cost == pytest.approx(ends[0].minimum.cost, abs=0.1) for end in ends)
        (found,) = disturbances(ends[0])
        assert found.shown
        assert abs(math.log(found.std / 3.0)) < 3.0 * (found.std_error or 0.0) / found.std

    def test_intervals_of_disturbance_and_vehicle_contain_the_truth(self) -> None:
        """40 records: enough of the 95 % intervals of each number contain the truth (1 in 1000 runs has fewer)."""
        truth = {"inertia": 1620.0, "gravity_stiffness": 13650.0, "std": 8.0, "time": 0.3}
        held = dict.fromkeys(truth, 0)
        for seed in range(40):
            found = fit(_task(Shaken().record(seed, 20.0)))
            (each,) = disturbances(found)
            assert each.std_error is not None
            assert each.correlation_time is not None
            assert each.correlation_time_error is not None
            deviations = np.sqrt(np.diag(np.linalg.inv(found.minimum.information)))
            names = [parameter.name for parameter in found.problem.parameters]
            estimates = {
                name: (found.minimum.common[names.index(name)], deviations[names.index(name)])
                for name in ("inertia", "gravity_stiffness")
            }
            # Their logarithms are closer to a normal distribution than the values themselves.
            estimates["std"] = (math.log(each.std), each.std_error / each.std)
            estimates["time"] = (math.log(each.correlation_time), each.correlation_time_error / each.correlation_time)
            for name, (value, std) in estimates.items():
                right = math.log(truth[name]) if name in ("std", "time") else truth[name]
                held[name] += abs(value - right) < 1.96 * std
        least = int(binom.ppf(1e-3, 40, 0.95))
        assert all(count >= least for count in held.values()), held

    def test_absent_disturbance_has_an_upper_bound(self) -> None:
        (found,) = disturbances(fit(_task(Shaken(rms=0.0).record(2))))
        assert not found.shown
        assert found.std < 1.0
        assert "less than" in str(found)

    def test_disturbance_is_reported_separately_from_the_parameters(self, shaken: Recording) -> None:
        estimate = prediction_error(NOMINAL, [shaken], support=VEHICLE.support)
        assert "disturbance_roll_time" not in estimate.parameters
        assert estimate.to_json()["disturbance"]["roll"]["rms"] == pytest.approx(8.0, abs=1.5)


def test_numbers_are_rounded_to_their_errors() -> None:
    assert with_error(8.123, 0.4123) == "8.12 ± 0.41"
    assert with_error(0.3142, 0.0312) == "0.314 ± 0.031"
    assert with_error(1613.0, 152.0, "N m") == "1.61 ± 0.15 kN m"


class TestCompare:
    def test_all_models_are_compared_with_the_disturbance_of_the_best_one(self) -> None:
        record = Shaken(more=lambda time, roll, rate: -900.0 * rate).record(3)
        with_it = NOMINAL.add("viscous_friction").change({"viscous_friction.coefficient": 900.0})
        values = {"inertia": 1620.0, "gravity_stiffness": 13650.0}
        without, right = compare(
            {"without": NOMINAL.change(values), "right": with_it.change(values)}, [record], support=VEHICLE.support
        )
        assert right.adequate
        assert not without.adequate
        assert right.innovation_ratio == pytest.approx(1.0, abs=0.05)
        assert without.rmse["roll"] > 1.5 * right.rmse["roll"]
        assert without.disturbance[0].std > 1.5 * right.disturbance[0].std
        assert right.disturbance[0].std == pytest.approx(8.0, abs=1.5)


def _diagnosed(record: Recording, **options: object) -> Diagnosis:
    return diagnose(NOMINAL, [record], support=VEHICLE.support, **options)  # type: ignore[arg-type]


class TestDiagnosis:
    @pytest.mark.parametrize("time", [0.05, 0.3, 1.5])
    def test_random_torque_leaves_the_model_adequate(self, time: float) -> None:
        found = _diagnosed(Shaken(rms=12.0, correlation_time=time).record(4))
        assert found.verdict is Verdict.ADEQUATE
        assert found.disturbance[0].std == pytest.approx(12.0, rel=0.35)
        assert found.prediction_limit is not None
        assert found.prediction_limit.disturbed["roll"] > 1.5 * found.prediction_limit.undisturbed["roll"]

    def test_torque_that_depends_on_a_state_is_found_as_an_effect(self) -> None:
        record = Shaken(more=lambda time, roll, rate: -600.0 * rate).record(5)
        found = _diagnosed(record)
        assert [each.effect for each in found.findings] == ["viscous_friction"]
        assert found.disturbance[0].std == pytest.approx(8.0, abs=1.5)
        coefficient = found.findings[0].parameters["viscous_friction.coefficient"]
        assert coefficient.value is not None
        assert coefficient.std is not None
        assert abs(coefficient.value - 600.0) < 3.0 * coefficient.std
        assert found.findings[0].relevance is not None
        assert found.findings[0].relevance.ahead > 10.0

    def test_periodic_torque_is_found_as_an_effect(self) -> None:
        record = Shaken(more=lambda time, roll, rate: 15.0 * math.sin(2.0 * math.pi * 1.7 * time)).record(6)
        assert [each.effect for each in _diagnosed(record).findings] == ["periodic_disturbance"]

    def test_gust_is_reported_as_an_event(self) -> None:
        found = _diagnosed(Shaken(gust=5.0, gust_from=20.0, gust_to=25.0).record(7, 60.0))
        assert found.verdict is Verdict.ADEQUATE
        (event,) = found.events
        assert event.begin == pytest.approx(20.0, abs=1.0)
        assert event.end == pytest.approx(25.0, abs=1.0)
        assert event.ratio > 2.0
        assert "event" in found.reason
        assert found.disturbance[0].std == pytest.approx(8.0, abs=1.5)

    @pytest.mark.parametrize(("gust", "least", "most"), [(1.0, 0.0, 0.06), (5.0, 0.9, 1.0)])
    def test_scattered_impulses_are_no_event_and_hide_none(self, gust: float, least: float, most: float) -> None:
        """Parts of 50 samples scatter by half a neper: with a Gaussian of one variance each record has an event."""
        chances = []
        for seed in range(50):
            random = np.random.default_rng(seed)
            impulses = random.standard_normal(12000) * np.repeat(np.exp(0.5 * random.standard_normal(240)), 50)
            impulses[4000:5000] *= gust
            squares = impulses**2 / np.mean(impulses**2)
            best, tried = _best(squares, 200)
            assert best is not None
            rest = np.concatenate((squares[: best[0]], squares[best[1] :]))
            chances.append(tried * _by_chance(best[2], rest, 200))
        assert least <= float(np.mean(np.array(chances) < LEVEL)) <= most

    @pytest.mark.thorough
    def test_constant_disturbance_has_no_event(self) -> None:
        assert not any(_diagnosed(Shaken().record(seed, 60.0), candidates=()).events for seed in range(8))

    def test_dominant_disturbance_is_reported_with_the_required_excitation(self) -> None:
        """A carriage of 2 kg that is driven by hundredths of a newton and disturbed by whole newtons."""
        random, spacing, rows = np.random.default_rng(9), 0.01, 4000
        force = 0.02 * np.sign(np.sin(2.0 * np.pi * 0.37 * spacing * np.arange(rows)))
        torque = position = rate = 0.0
        shown = []
        for push in force.tolist():
            shown.append(position)
            torque = 0.97 * torque + 1.5 * math.sqrt(1.0 - 0.97**2) * float(random.standard_normal())
            rate += spacing * (push + torque) / 2.0
            position += spacing * rate
        model = axis(force_scale=1.0).change({"inertia": 1.5}, deviations={"inertia": 0.5})
        channels = ChannelTable(Channel(name, unit, "") for name, unit in (("position", "m"), ("force", "N")))
        values = {"position": np.array(shown) + 1e-4 * random.standard_normal(rows), "force": force}
        record = Recording(channels, np.arange(rows, dtype=np.int64) * 10_000_000, values)
        found = diagnose(model, [record])
        assert found.verdict is Verdict.INSUFFICIENT_DATA
        assert "N RMS" in found.reason
        assert "times as large" in found.reason


class TestBudget:
    def test_fit_without_time_left_fails(self, shaken: Recording) -> None:
        with pytest.raises(OutOfTime):
            fit(replace(_task(shaken), budget=Budget.of(0.0)))

    def test_search_without_time_lists_what_it_left_untried(self, shaken: Recording) -> None:
        record = Shaken(more=lambda time, roll, rate: -600.0 * rate).record(5)
        found = _diagnosed(record, budget=0.0)
        assert "viscous_friction" in found.untried
        assert not found.findings

    def test_stiff_effect_does_not_keep_the_others_from_being_tried(self) -> None:
        record = Shaken(more=lambda time, roll, rate: -600.0 * rate).record(5)
        stiff = Effect(
            name="stiff_spring",
            family=Family.MEMORY,
            title="a spring that is far too stiff to follow",
            place=Place.JOINT,
            equation="F = -torque z",
            parameters=(EffectParameter("torque", "{force}", "size", amplitude=True, scale="force_scale"),),
            signature="None.",
            confused_with=(),
            separated_by="Nothing.",
            force="-torque * z",
            states=(EffectState("z", "1", "5e4 * (tanh(rate / smooth_rate) - z)", "of the spring"),),
        )
        found = _diagnosed(record, candidates=(stiff, "viscous_friction", "coulomb_friction"), budget=8.0)
        assert [each.effect for each in found.findings] == ["viscous_friction"]


RIGHT = {
    "clean": None,
    "clean_slow": None,
    "cubic_stiffness_9e6": "cubic_stiffness",
    "input_asymmetry_7pct": "input_asymmetry",
    "input_delay_20ms": "input_delay",
}


@pytest.mark.parametrize(
    ("name", "effect"), of_many(RIGHT.items(), ("clean", None), ("cubic_stiffness_9e6", "cubic_stiffness"))
)
def test_effect_and_disturbance_of_another_simulator_are_found(
    measured_data: Path, name: str, effect: str | None
) -> None:
    """The hidden effect is first, or tied with the first: a delay of a model's inputs is one of its outputs."""
    found = _diagnosed(load_recording(measured_data / "shaken" / f"{name}.csv"))
    if effect is None:
        assert found.verdict is Verdict.ADEQUATE
        assert not found.findings
    else:
        first = found.findings[0]
        assert effect in (first.effect, *first.tied_with)
        assert len(first.tied_with) <= 1
    rms, time = {"clean_slow": (15.0, 2.0)}.get(name, (8.0, 0.3))
    (estimate,) = found.disturbance
    assert estimate.std_error is not None
    assert estimate.correlation_time is not None
    assert estimate.correlation_time_error is not None
    assert abs(estimate.std - rms) < 3.0 * estimate.std_error
    assert abs(estimate.correlation_time - time) < 3.0 * estimate.correlation_time_error
