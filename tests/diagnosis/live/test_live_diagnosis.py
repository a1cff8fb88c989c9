"""The live diagnosis on the virtual vehicle: its names and onsets, its false alarms, and that it disturbs nothing."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import cache
from typing import Any

import golden
import numpy as np
import pytest
from monocab_channels import MONOCAB
from observer_harness import VEHICLE
from thorough import of_many

from upright.diagnosis.live.line import RECENT, LineFinder, strongest
from upright.diagnosis.live.live import LiveDiagnosis
from upright.diagnosis.live.naming import Gathered, LiveFinding, LiveResult
from upright.diagnosis.prepare.candidates import candidates_for
from upright.diagnosis.prepare.workspace import attached
from upright.estimators.fit.random.disturbance import is_of_disturbance
from upright.estimators.identify.run import with_values
from upright.estimators.methods.prediction_error import prediction_error
from upright.estimators.recursive.prediction_error import RecursivePredictionError
from upright.estimators.recursive.predictor import Seen
from upright.models.compiler.kernel import compile_model
from upright.models.effects.catalogue import CATALOGUE
from upright.models.parts import ModelError
from upright.models.random.disturbance import disturbed
from upright.models.segment import Segment
from upright.service.observer.live.news import News
from upright.service.observer.live.online_estimators import online_estimators
from upright.service.output import missing_effects
from upright.service.virtual.run import BOOT_TIME
from upright.simulation.vehicle import START_NS
from upright.telemetry.recording import Recording
from upright.vehicles.registry import nominal_model

GIVEN: dict[str, Any] = {
    "parameters": VEHICLE.parameters.values,
    "deviations": VEHICLE.parameters.deviations,
    "support": VEHICLE.support,
    "channels": MONOCAB,
}


@cache
def recorded(*hide: str, excitation: str = "multisine", seed: int = 1, duration: float = 30.0) -> Recording:
    return golden.recorded("monocab", excitation, hide=hide, seed=seed, duration=duration)


def course(recording: Recording, diagnosis: LiveDiagnosis | None = None) -> list[tuple[float, LiveResult]]:
    """The result after every second, with the time in s from the first sample."""
    diagnosis = diagnosis or LiveDiagnosis(nominal_model("monocab"), **GIVEN)
    results, begin = [], recording.timestamp_ns[0]
    for number, frame in enumerate(recording.frames(MONOCAB)):
        diagnosis.update(frame)
        if number % VEHICLE.control.rate == 0:
            results.append(((frame.timestamp_ns - begin) * 1e-9, diagnosis.result()))
    return results


def onset(recording: Recording, second: float) -> float:
    """Onset, s from the first sample, of an effect that sets in `second` s after the drives started."""
    return BOOT_TIME + second - (int(recording.metadata["start_ns"]) - START_NS) * 1e-9


def size(finding: LiveFinding) -> tuple[float, float]:
    ((value, std, _),) = finding.sizes.values()
    return value, std


@pytest.mark.parametrize(
    ("excitation", "seed"),
    of_many([("multisine", 1), ("multisine", 2), ("sweep", 1), ("hold", 1)], ("multisine", 2), ("hold", 1)),
)
def test_nothing_is_named_at_any_time_if_nothing_is_missing(excitation: str, seed: int) -> None:
    """By its level, one false name in a hundred minutes; seeds are fixed. One record has a line due to chance alone."""
    results = course(recorded(excitation=excitation, seed=seed))
    assert [result.findings for _, result in results] == [()] * len(results)
    assert results[0][1].verdict == "insufficient_data"
    assert results[-1][1].verdict == "adequate"
    assert results[-1][1].detectable["viscous_friction"] > 0.0


@pytest.mark.parametrize("seed", of_many([11, 12], 11))
def test_disturbed_vehicle_has_no_finding_and_the_disturbance_of_the_batch_fit(seed: int) -> None:
    """8 N m RMS with 0.3 s. Both use the same record except 0.1 s at its ends: half a standard deviation is allowed."""
    recording = recorded("disturbance=8,0.3", seed=seed)
    diagnosis = LiveDiagnosis(nominal_model("monocab"), **GIVEN)
    results = course(recording, diagnosis)
    assert [result.findings for _, result in results] == [()] * len(results)
    assert results[-1][1].verdict == "adequate"
    model = with_values(nominal_model("monocab"), GIVEN["parameters"], GIVEN["deviations"])
    (fitted,) = prediction_error(model, [recording], support=VEHICLE.support).disturbance
    estimate = diagnosis.estimator.result()
    assert not set(estimate.parameters) & is_of_disturbance(disturbed(model, ()))
    (running,) = estimate.disturbance
    for live, batch, truth in (
        ((running.std, running.std_error), (fitted.std, fitted.std_error), 8.0),
        (
            (running.correlation_time, running.correlation_time_error),
            (fitted.correlation_time, fitted.correlation_time_error),
            0.3,
        ),
    ):
        assert None not in (*live, *batch)
        assert abs(live[0] - batch[0]) < 0.5 * batch[1]  # type: ignore[operator]
        assert abs(live[0] - truth) < 3.0 * live[1]  # type: ignore[operator]
        assert live[1] == pytest.approx(batch[1], rel=0.3)
    entry = results[-1][1].to_json()["disturbance"]["roll"]
    assert entry["rms"] == pytest.approx(running.std, abs=running.std_error)
    assert entry["shown"]


def test_friction_that_sets_in_on_a_disturbed_vehicle_is_named() -> None:
    recording = recorded("disturbance=8,0.3", "viscous_friction=1@25")
    begin, results = onset(recording, 25.0), course(recording)
    named = [(time, result.findings[0]) for time, result in results if result.findings]
    right = [time for time, each in named if "viscous_friction" in (each.effect, *each.tied_with)]
    assert named[0][0] > begin
    assert right[0] == named[0][0]
    assert right[0] - begin < 5.0 + 1.0  # one result a second
    assert "viscous_friction" in (results[-1][1].findings[0].effect, *results[-1][1].findings[0].tied_with)


def test_friction_that_sets_in_is_named_within_five_seconds_with_onset_and_size() -> None:
    recording = recorded("viscous_friction=0.5@25")
    begin, results = onset(recording, 25.0), course(recording)
    named = [(time, result.findings[0]) for time, result in results if result.findings]
    assert named[0][0] > begin
    assert named[0][0] - begin < 5.0 + 1.0  # one result a second
    # In its first seconds friction is hardly distinguishable from its neighbours: it may be one of the tied effects.
    right = [time for time, each in named if "viscous_friction" in (each.effect, *each.tied_with)]
    assert right[0] - begin < 5.0 + 1.0
    last = results[-1][1].findings[0]
    assert last.effect == "viscous_friction"
    assert abs(last.since - begin) < 1.5
    value, std = size(last)
    # 200 N m s/rad. One linear step from a model without friction, whose noise took its place: only a rough size.
    assert 100.0 < value < 400.0
    assert 0.0 < std < 0.2 * value


def test_weak_friction_is_named_within_five_seconds_with_effects_tied_so_far() -> None:
    """Three times the minimum detectable amplitude in 30 s: in five seconds kinds of friction hardly differ."""
    recording = recorded("coulomb_friction=0.0263@25")
    begin, results = onset(recording, 25.0), course(recording)
    named = [(time, result.findings[0]) for time, result in results if result.findings]
    assert begin < named[0][0] < begin + 5.0 + 1.0
    for _, each in named:
        assert "coulomb_friction" in (each.effect, *each.tied_with)
        assert len(each.tied_with) <= 4
        assert each.p_value < 0.01


def test_only_every_other_second_is_evaluated_if_no_effect_is_near_a_name(monkeypatch: pytest.MonkeyPatch) -> None:
    """From soon after an onset, every second is evaluated."""
    evaluated: list[int] = []
    look = Gathered.look

    def counted(self: Gathered, *arguments: Any) -> LiveResult:
        evaluated.append(self.products.seconds)
        return look(self, *arguments)

    monkeypatch.setattr(Gathered, "look", counted)
    recording = recorded("viscous_friction=0.5@25")
    results = course(recording)
    begin = onset(recording, 25.0)
    quiet = max(result.seconds for time, result in results if time < begin)
    before, after = ([each for each in evaluated if (each > quiet) is late] for late in (False, True))
    assert len(set(before)) < 0.8 * quiet
    assert max(np.diff(before)) <= 2
    # Within two seconds it is near a name; after that no second is left out.
    assert set(range(quiet + 3, max(after) + 1)) <= set(after)


def test_nothing_is_named_until_an_effect_explains_the_data() -> None:
    """Machinery starts: until its frequency is known, no candidate resembles it. A weaker disturbance is taken for a
    random force until then. A second effect that is named beside it is not tested."""
    recording = recorded("periodic_disturbance=4@25")
    begin, results = onset(recording, 25.0), course(recording)
    for _, result in results:
        for each in result.findings[:1]:
            assert "periodic_disturbance" in (each.effect, *each.tied_with)
    assert results[-1][1].findings
    unknown = [
        (time, result) for time, result in results if time > begin and "no known effect explains" in result.reason
    ]
    assert unknown
    assert unknown[0][0] < begin + 5.0 + 1.0
    assert unknown[0][1].verdict == "insufficient_data"
    assert unknown[0][1].detectable


def test_dry_friction_from_the_beginning_has_no_onset_and_is_named_with_its_ties() -> None:
    finding = course(recorded("coulomb_friction=0.5"))[-1][1].findings[0]
    assert finding.effect in ("coulomb_friction", "asymmetric_friction")
    assert "coulomb_friction" in (finding.effect, *finding.tied_with)
    assert finding.since == 0.0
    assert finding.p_value < 1e-6


def test_person_who_sits_down_is_named_a_torque_step() -> None:
    recording = recorded("torque_step=0.2@25")
    finding = course(recording)[-1][1].findings[0]
    assert finding.effect == "torque_step"
    assert abs(finding.since - onset(recording, 25.0)) < 1.5
    assert finding.family == "bias"


def test_periodic_disturbance_is_named_with_its_frequency() -> None:
    """Machinery on board at 1.3 Hz; the catalogue starts from 1 Hz, which a record of 30 s distinguishes from it."""
    finding = course(recorded("periodic_disturbance=0.5"))[-1][1].findings[0]
    assert finding.effect == "periodic_disturbance"
    frequency, std, unit = finding.sizes["periodic_disturbance.frequency"]
    assert unit == "Hz"
    assert abs(frequency - 1.3) < min(0.05, 2.0 * std)
    assert f"frequency = {frequency:.4f}" in finding.explanation


@pytest.mark.parametrize("frequency", [0.31, 1.337, 7.77])
def test_spectral_line_between_the_bins_is_found(frequency: float) -> None:
    """In noise of the same power, to a tenth of a bin of 1/20 Hz. Only the last 32 s are evaluated."""
    rng = np.random.default_rng(3)
    finder, time = LineFinder(0.004), 0.004 * np.arange(10_000)
    signal = np.stack((np.sin(2.0 * np.pi * frequency * time), np.zeros(len(time))), axis=1)
    assert finder.frequency() is None
    finder.add(rng.standard_normal((5000, 2)) * 100.0)
    for part in np.array_split(signal + 0.7 * rng.standard_normal(signal.shape), 40):
        finder.add(part)
    found = finder.frequency()
    assert found is not None
    assert abs(found[0] - frequency) < 0.1 / 20.0
    assert 31.0 <= found[1] <= 33.0


def test_spectral_line_that_has_just_begun_is_found_in_the_recent_samples() -> None:
    """Half the noise in amplitude, in the last 5 of 31 s; in all 31 s another line, due to chance, is stronger."""
    rng = np.random.default_rng(5)
    time = 0.004 * np.arange(7750)
    rows = rng.standard_normal((len(time), 2))
    rows[time >= 26.0, 0] += 0.5 * np.sin(2.0 * np.pi * 1.3 * time[time >= 26.0])
    finder = LineFinder(0.004)
    for part in np.array_split(rows, 31):
        finder.add(part)
    found = finder.frequency()
    assert found is not None
    assert abs(found[0] - 1.3) < 0.5 / 5.0, "to within half a width of a line of 5 s"
    assert found[1] == pytest.approx(RECENT, abs=0.1)
    assert abs(strongest(rows, 0.004)[1] - 1.3) > 0.5, "or all of it would have done"


def test_noise_alone_rarely_gives_a_spectral_line() -> None:
    """In at most a tenth of 40 draws: more than 9 would occur with less than one seed in a hundred."""
    rng = np.random.default_rng(11)
    followed = 0
    for _ in range(40):
        finder = LineFinder(0.004)
        finder.add(rng.standard_normal((4000, 2)))
        followed += finder.frequency() is not None
    assert followed <= 9


def test_recursive_estimator_gives_the_same_numbers_with_and_without_diagnosis() -> None:
    diagnosis, alone = (
        LiveDiagnosis(nominal_model("monocab"), **GIVEN),
        RecursivePredictionError(nominal_model("monocab"), **GIVEN),
    )
    for frame in recorded().frames(MONOCAB):
        diagnosis.update(frame)
        alone.update(frame)
    assert diagnosis.estimator.result().to_json() == alone.result().to_json()


def test_same_cycles_give_the_same_diagnosis_after_a_reset() -> None:
    diagnosis = LiveDiagnosis(nominal_model("monocab"), **GIVEN)
    first = course(recorded("coulomb_friction=0.5"), diagnosis)[-1][1]
    diagnosis.reset()
    assert diagnosis.result().verdict == "insufficient_data"
    assert course(recorded("coulomb_friction=0.5"), diagnosis)[-1][1] == first


def test_failure_ends_the_diagnosis_but_not_the_recursive_estimator(monkeypatch: pytest.MonkeyPatch) -> None:
    diagnosis = LiveDiagnosis(nominal_model("monocab"), **GIVEN)

    def fails(*_: object) -> None:
        raise np.linalg.LinAlgError("made up")

    monkeypatch.setattr(diagnosis, "_effects", fails)
    result = course(recorded(), diagnosis)[-1][1]
    assert (result.verdict, result.findings) == ("insufficient_data", ())
    assert "made up" in result.reason
    assert diagnosis.estimator.result().status == "ok"


def test_integration_steps_are_refined_for_a_fast_effect() -> None:
    """Backlash, crossed within a cycle: with one step per sample its derivative diverges, with finer steps not."""
    diagnosis = LiveDiagnosis(
        nominal_model("monocab"), effects=[replace(each, stiff=False) for each in CATALOGUE.values()], **GIVEN
    )
    result = course(recorded(), diagnosis)[-1][1]
    assert "backlash" in result.detectable
    assert not result.reason


def test_gap_begins_a_new_segment_and_causes_no_finding() -> None:
    recording = recorded()
    frames = list(recording.frames(MONOCAB))
    diagnosis = LiveDiagnosis(nominal_model("monocab"), **GIVEN)
    seen: list[Seen] = []
    watch = diagnosis.estimator.watch
    assert watch is not None
    diagnosis.estimator.watch = lambda each: (seen.append(each), watch(each))[1]
    for frame in [*frames[:5000], *frames[5400:]]:
        diagnosis.update(frame)
    assert sum(each.chunk.begins and each.count == 0 for each in seen) == 2
    result = diagnosis.result()
    assert (result.verdict, result.findings) == ("adequate", ())
    assert result.seconds < 0.8 * len(frames) / VEHICLE.control.rate


def test_bank_gives_the_diagnosis_as_json_and_news_reports_it_once() -> None:
    bank = online_estimators("monocab", GIVEN["parameters"], GIVEN["deviations"], GIVEN["support"], MONOCAB)
    waiting = bank.diagnosis()
    assert waiting is not None
    assert (waiting["verdict"], waiting["findings"]) == ("insufficient_data", [])
    assert "compiled" in waiting["reason"]
    bank.join()
    bank.update(recorded("coulomb_friction=0.5").frames(MONOCAB))
    document = json.loads(json.dumps(bank.diagnosis()))
    assert document["verdict"] == "missing_effect"
    assert {"effect", "family", "parameters", "probability", "p_value", "tied_with", "explanation", "since"} <= set(
        document["findings"][0]
    )
    news = News()
    (text,) = news.of({**document, "findings": document["findings"][:1]})
    assert "friction" in text
    assert "N m" in text
    assert news.of({**document, "findings": document["findings"][:1]}) == []


def test_terminal_shows_the_effect_with_its_onset_value_and_ties() -> None:
    finding = {
        "effect": "coulomb_friction",
        "parameters": {"coulomb_friction.torque": {"value": 31.25, "std": 2.2, "unit": "N m", "identifiable": True}},
        "tied_with": ["asymmetric_friction"],
        "since": 26.4,
    }
    text = missing_effects({"verdict": "missing_effect", "findings": [finding], "reason": "", "seconds": 30})
    assert "coulomb_friction since 26 s: torque 31.2 ± 2.2 N m, or asymmetric_friction" in text
    nothing = missing_effects({"verdict": "adequate", "findings": [], "reason": "", "seconds": 30})
    assert nothing == "missing effect: none detected in 30 s"
    early = missing_effects({"verdict": "insufficient_data", "findings": [], "reason": "no [free] motion"})
    assert r"no \[free] motion" in early
    assert missing_effects(None) == ""


def test_kernel_for_candidates_at_zero_agrees_with_that_of_the_whole_model() -> None:
    model = nominal_model("monocab")
    found, _ = candidates_for(model, (), ("coulomb_friction", "hysteresis", "position_cogging", "sensor_delay"))
    found += candidates_for(model, (), ("gyro_bias", "sensor_scale", "cubic_stiffness"))[0]
    wide, names = attached(model, found), [name for each in found for name in each.amplitudes]
    whole, quick = compile_model(wide), compile_model(wide, neutral=names)
    values = whole.vector(dict.fromkeys(names, 0.0))
    random, time = np.random.default_rng(4), 0.004 * np.arange(300)
    inputs = 0.01 * np.sin(np.outer(time, 3.0 + np.arange(len(whole.inputs))))
    knots = np.ascontiguousarray(np.repeat(time[:, None], len(whole.inputs), axis=1))
    # So slow that the steps can follow a hysteresis: otherwise rounding errors grow.
    measured = 1e-4 * random.standard_normal((len(time), len(whole.outputs)))
    segment = Segment(time, knots, inputs, measured)
    gain = np.zeros((len(whole.states), len(whole.outputs)))
    gain[:2] = 0.2 * np.eye(2)
    initial, active = np.full(len(whole.states), 1e-3), [whole.index(name) for name in names]
    full = whole.run(segment, values, initial, gain=gain, active=active)
    reduced = quick.run(segment, values, initial, gain=gain, active=active)
    np.testing.assert_allclose(reduced.predicted, full.predicted, rtol=1e-12, atol=1e-15)
    scale = np.max(np.abs(full.sensitivity), axis=(0, 1))
    assert (scale > 0.0).all()
    np.testing.assert_allclose(reduced.sensitivity / scale, full.sensitivity / scale, atol=1e-11)  # rounding alone
    with pytest.raises(ModelError):
        quick.run(segment, values, initial, active=[whole.index(model.parameters[0].name)])
    values[active[0]] = 1.0
    with pytest.raises(ModelError):
        quick.run(segment, values, initial, active=active)
