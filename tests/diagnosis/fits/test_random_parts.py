"""The random parts beside the first-order disturbance: their generation, estimation and distinction from effects."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.stats import binom
from shaken_plant import Shaken
from thorough import of_many

from benchmarks.others_recordings import EFFECTS, SENSORS, OthersVehicle
from upright.diagnosis.diagnose import Diagnosis, Verdict, diagnose
from upright.diagnosis.fits.random_parts import RANDOM
from upright.diagnosis.lack_of_fit.colour import LEVEL, _blocks, signals
from upright.diagnosis.prepare.ready import ready
from upright.diagnosis.prepare.workspace import Workspace
from upright.diagnosis.report.sentences import disturbance_sentences, to_within
from upright.diagnosis.search import search as searching
from upright.diagnosis.search.explanation import NOTHING_SCORED, Explanation, Search
from upright.diagnosis.search.search import Found
from upright.estimators.budget import OutOfTime
from upright.estimators.disturbance_estimate import DisturbanceEstimate, NarrowBandEstimate
from upright.estimators.fit.maximum_likelihood import fit
from upright.estimators.fit.problem import problem
from upright.estimators.fit.random.disturbance import disturbances
from upright.estimators.identify.run import with_values
from upright.estimators.methods.prediction_error import prediction_error
from upright.models.file.model_file import parse, read
from upright.models.file.model_file import write as write_model
from upright.models.model import Model
from upright.models.parts import Disturbance, ModelError
from upright.models.parts import NarrowBand as KnownBand
from upright.models.random.disturbance import at_joints, disturbed, undisturbed, with_narrow_band
from upright.service.offline.inputs.replay import load as load_recording
from upright.service.virtual.run import record
from upright.simulation.monocab.hidden import MONOCAB
from upright.simulation.physics.narrow_band import NarrowBand, NarrowBandTorque
from upright.simulation.registry import UnknownEffectError, parse_narrow_band
from upright.telemetry.recording import Recording
from upright.vehicles.file import load
from upright.vehicles.registry import nominal_model

VEHICLE = load("monocab")
NOMINAL = with_values(nominal_model("monocab"), VEHICLE.parameters.values, VEHICLE.parameters.deviations).remove(
    "static_torque"
)
STEP = 1.0 / 3000.0
"""s, step of the plant at 250 Hz."""
MOST = 4.0
"""Standard deviations by which an estimate may be off: 6 of 100,000 seeds exceed them."""


# --- of the virtual vehicle


def test_narrow_band_torque_has_its_rms_frequency_and_damping_ratio() -> None:
    """Its autocorrelation is rms^2 exp(-z w t) (cos(w' t) + z sin(w' t) w / w'), w' = w sqrt(1 - z^2); estimates over D
    s scatter like those of at least D z w / 2 independent values."""
    band, duration = NarrowBand(4.0, 2.0, 0.05), 2000.0
    random = NarrowBandTorque(band, 0.01, 5)
    torque = np.array([random.torque(0.0) for _ in range(round(duration / 0.01))])
    turn, damping = 2.0 * math.pi * band.frequency, band.damping
    within = MOST / math.sqrt(0.5 * duration * damping * turn)
    assert float(np.std(torque)) == pytest.approx(band.rms, rel=within)
    assert abs(float(np.mean(torque))) < within * band.rms
    damped = turn * math.sqrt(1.0 - damping**2)
    for rows in (12, 25, 50, 100):
        lag = 0.01 * rows
        swing = math.cos(damped * lag) + damping * turn / damped * math.sin(damped * lag)
        expected = math.exp(-damping * turn * lag) * swing
        found = float(np.mean(torque[rows:] * torque[:-rows])) / band.rms**2
        assert found == pytest.approx(expected, abs=within)


def test_narrow_band_torque_is_stationary_at_once_and_follows_from_its_seed() -> None:
    first = [NarrowBandTorque(NarrowBand(8.0, 2.0, 0.05), STEP, seed).torque(0.0) for seed in range(400)]
    assert math.sqrt(float(np.mean(np.square(first)))) == pytest.approx(8.0, rel=MOST * math.sqrt(0.5 / 400))
    assert NarrowBandTorque(NarrowBand(8.0, 2.0, 0.05), STEP, 7).torque(0.0) == first[7]


@pytest.mark.parametrize(
    ("argument", "expected"),
    [
        ("narrow_band", NarrowBand(4.0, 2.0, 0.05)),
        ("narrow_band=2", NarrowBand(8.0, 2.0, 0.05)),
        ("narrow_band=3,1.5,0.1@30", NarrowBand(3.0, 1.5, 0.1, onset=30.0)),
        ("narrow_band=0", None),
    ],
)
def test_narrow_band_is_requested_like_a_hidden_effect(argument: str, expected: NarrowBand | None) -> None:
    assert parse_narrow_band(["coulomb_friction=2", argument], MONOCAB) == (["coulomb_friction=2"], expected)


@pytest.mark.parametrize("argument", ["narrow_band=3,2", "narrow_band=-1,2,0.1", "narrow_band=3,2,1", "narrow_band=x"])
def test_invalid_narrow_band_is_refused_with_the_remedy(argument: str) -> None:
    with pytest.raises(UnknownEffectError, match=r"narrow_band=4,2,0\.05.*narrow_band=0 switches it off"):
        parse_narrow_band([argument], MONOCAB)


@pytest.mark.parametrize(("vehicle", "channel"), [("monocab", "roll"), ("twsbr", "tilt")])
def test_narrow_band_changes_the_motion_of_the_virtual_vehicles(vehicle: str, channel: str) -> None:
    shaken, still = (record(vehicle, "hold", hide=hide, seed=3, duration=5.0) for hide in (["narrow_band"], []))
    assert not np.array_equal(shaken.values[channel], still.values[channel])


# --- in fits


def shaken(band: NarrowBand, seed: int, seconds: float = 30.0) -> Recording:
    """A record of the tests' own vehicle, with a first-order disturbance of 8 N m RMS as well."""
    random = NarrowBandTorque(band, 1e-3, seed + 100)
    return Shaken(more=lambda time, roll, rate: random.torque(time)).record(seed, seconds)


def with_band(record: Recording, frequency: float, seconds: float) -> Model:
    model = disturbed(NOMINAL, [record])
    ((joint, _),) = at_joints(model)
    return with_narrow_band(model, joint.name, KnownBand(frequency), seconds)


def test_intervals_of_rms_frequency_and_damping_ratio_contain_the_truth() -> None:
    """Of 20 of their 95 % intervals, in logarithms, enough contain the truth (1 in 1000 runs has fewer)."""
    band, held = NarrowBand(6.0, 2.0, 0.05), np.zeros(3)
    for seed in range(20):
        record = shaken(band, seed, 60.0)
        model = with_band(record, 2.3, 60.0)
        (found,) = disturbances(fit(problem(model, [record], support=VEHICLE.support)))
        estimate = found.narrow_band
        assert estimate is not None
        values = np.array([estimate.std, estimate.frequency, estimate.damping])
        errors = np.array([estimate.std_error, estimate.frequency_error, estimate.damping_error])
        held += np.abs(np.log(values / [band.rms, band.frequency, band.damping])) < 1.96 * errors / values
    assert np.all(held >= binom.ppf(1e-3, 20, 0.95)), held


def test_undisturbed_model_has_no_narrow_band() -> None:
    record = shaken(NarrowBand(4.0, 2.0, 0.05), 1)
    model = with_band(record, 2.0, 30.0)
    assert len(model.base_states) == len(NOMINAL.base_states) + 3
    left = undisturbed(NOMINAL, model)
    assert (left.base_states, left.base_parameters, left.joints) == (
        NOMINAL.base_states,
        NOMINAL.base_parameters,
        NOMINAL.joints,
    )


NARROW = NarrowBandEstimate("N m", 3.0, 0.2, 2.1, 0.03, 0.05, 0.01)


@pytest.mark.parametrize(
    ("shown", "said"),
    [
        (
            True,
            "8.10 ± 0.40 N m RMS, correlation time 0.310 ± 0.030 s, and 3.00 ± 0.20 N m RMS about 2.100 ± 0.030 Hz",
        ),
        (False, "3.00 ± 0.20 N m RMS about 2.100 ± 0.030 Hz"),
    ],
)
def test_narrow_band_is_reported_beside_the_first_order_disturbance(shown: bool, said: str) -> None:
    errors = (0.4, 0.31, 0.03) if shown else (None, None, None)
    found = DisturbanceEstimate("roll", "N m", 8.1, *errors, shown=shown, narrow_band=NARROW)
    assert f"{found}".startswith(said)
    assert f"{found}".endswith("damping ratio 0.050 ± 0.010")
    assert DisturbanceEstimate.from_json("roll", found.to_json()) == found


# --- in the diagnosis


def diagnosed(record: Recording) -> Diagnosis:
    return diagnose(NOMINAL, [record], support=VEHICLE.support)


def virtual(*hide: str, seed: int = 1) -> Recording:
    return record("monocab", "multisine", hide=["disturbance", *hide], seed=seed)


def agrees(found: Diagnosis, band: NarrowBand) -> bool:
    estimate = found.disturbance[0].narrow_band
    return estimate is not None and all(
        abs(value - truth) < 3.0 * error
        for value, error, truth in (
            (estimate.std, estimate.std_error, band.rms),
            (estimate.frequency, estimate.frequency_error, band.frequency),
            (estimate.damping, estimate.damping_error, band.damping),
        )
    )


def test_narrow_band_torque_leaves_the_model_adequate() -> None:
    found = diagnosed(virtual("narrow_band"))
    assert found.verdict is Verdict.ADEQUATE
    assert agrees(found, MONOCAB.narrow_band)
    assert "about 2.0" in to_within(found)
    assert "about 2.0" in disturbance_sentences(found)
    assert found.revised is not None
    assert found.revised.base_states == NOMINAL.base_states


@pytest.mark.patient
@pytest.mark.parametrize(
    ("hide", "narrow"),
    of_many(
        [
            ((), False),
            (("narrow_band", "cubic_stiffness"), True),
            (("periodic_disturbance",), False),
            (("flexible_mode",), False),
        ],
        ((), False),
        (("narrow_band", "cubic_stiffness"), True),
    ),
)
def test_effects_are_not_confounded_with_a_narrow_band(hide: tuple[str, ...], narrow: bool) -> None:
    found = diagnosed(virtual(*hide))
    assert [each.effect for each in found.findings] == list(hide[-1:])
    assert (found.disturbance[0].narrow_band is not None) is narrow


def test_periodic_and_narrow_band_torques_are_distinguished() -> None:
    random = NarrowBandTorque(NarrowBand(6.0, 3.0, 0.05), 1e-3, 102)
    record = Shaken(
        more=lambda time, roll, rate: random.torque(time) + 15.0 * math.sin(2.0 * math.pi * 1.3 * time)
    ).record(2)
    found = diagnosed(record)
    assert [each.effect for each in found.findings] == ["periodic_disturbance"]
    assert agrees(found, NarrowBand(6.0, 3.0, 0.05))


def test_white_noise_has_no_more_peaks_than_chance_allows() -> None:
    """Of 300 white signals, at the level of 1 %, no more have a peak than chance allows."""
    random, wrong = np.random.default_rng(8), 0
    for _ in range(300):
        lines = np.fft.rfft(random.standard_normal(2000))[1:-1]
        blocks = list(_blocks(np.abs(lines) ** 2 / 2000))
        wrong += min(blocks)[0] < LEVEL / len(blocks)
    assert wrong <= binom.ppf(0.999, 300, LEVEL)


def test_record_without_a_narrow_band_suggests_no_random_signal() -> None:
    """At the level of 1 %, a virtual vehicle without a narrow band has no peak."""
    record = virtual()
    assert not signals(fit(problem(ready(NOMINAL, [record]), [record], support=VEHICLE.support)))


# --- errors of sensors


def others(tmp_path: Path, sensor: str, seed: int = 11, **more: Any) -> Recording:
    """A record of another simulator: 8 N m RMS of disturbance, correlation time 0.3 s, that error of its sensors."""
    vehicle = OthersVehicle(sensors=SENSORS[sensor], disturbance=(8.0, 0.3), seed=seed, **more)
    return load_recording(vehicle.write(tmp_path / f"{sensor}.csv"), VEHICLE)


def within_error(found: float, error: float, truth: float) -> bool:
    return abs(math.log(found / truth)) < MOST * error / found


@pytest.mark.parametrize("sensor", of_many(["wander", "vibration"], "wander"))
def test_gyro_error_is_estimated_and_not_confounded_with_anything_else(tmp_path: Path, sensor: str) -> None:
    found = diagnosed(others(tmp_path, sensor))
    assert found.verdict is Verdict.ADEQUATE
    (estimate,) = found.sensor_errors
    assert estimate.channel == "roll_rate"
    (shaking,) = found.disturbance
    assert within_error(shaking.std, shaking.std_error or 0.0, 8.0)
    assert found.revised is not None
    assert [each.expression for each in found.revised.outputs] == [each.expression for each in NOMINAL.outputs]
    assert "roll_rate" in disturbance_sentences(found)
    assert found.to_json()["sensor_errors"]["roll_rate"]["unit"] == "rad/s"
    if sensor == "wander":
        rms, time = SENSORS[sensor].wander
        assert within_error(estimate.std, estimate.std_error, rms)
        assert within_error(estimate.correlation_time, estimate.correlation_time_error, time)
    else:
        rms, frequency, _ = SENSORS[sensor].vibration
        assert estimate.narrow_band is not None
        assert within_error(estimate.narrow_band.std, estimate.narrow_band.std_error, rms)
        # What the gyro senses, between displacement and velocity of the mode, shifts the peak a little.
        assert estimate.narrow_band.frequency == pytest.approx(frequency, rel=0.03)


def test_encoder_has_no_coloured_sensor_error(tmp_path: Path) -> None:
    found = diagnosed(others(tmp_path, "encoder"))
    assert found.verdict is Verdict.ADEQUATE
    assert not found.sensor_errors


@pytest.mark.thorough
def test_effect_is_found_beside_a_gyro_error(tmp_path: Path) -> None:
    found = diagnosed(others(tmp_path, "wander", **EFFECTS["viscous_friction"]))
    assert [each.effect for each in found.findings] == ["viscous_friction"]
    assert [each.channel for each in found.sensor_errors] == ["roll_rate"]


def test_narrow_band_can_be_stated_in_a_model_file(tmp_path: Path) -> None:
    text = 'base = "monocab_roll"\n[joints.roll.disturbance]\nnarrow_band = { frequency = 2.0, damping_ratio = 0.1 }\n'
    model = parse(text, "track.toml").model
    assert model.joints[0].disturbance == Disturbance(narrow_band=KnownBand(2.0, 0.1))
    write_model(parse(text, tmp_path / "track.toml"), tmp_path / "again.toml")
    assert read(tmp_path / "again.toml").model.joints == model.joints
    record = shaken(NarrowBand(6.0, 2.0, 0.05), 3, 60.0)
    (found,) = prediction_error(
        with_values(model, VEHICLE.parameters.values, VEHICLE.parameters.deviations), [record], support=0.3
    ).disturbance
    assert found.narrow_band is not None
    assert within_error(found.narrow_band.std, found.narrow_band.std_error, 6.0)
    with pytest.raises(ModelError, match=r"damping_ratio: 0\.3 is too large.*give 0\.16 at most"):
        parse(text.replace("0.1 ", "0.3 "), "track.toml")


@pytest.mark.parametrize("untried", [(), ("further effects",)])
def test_search_with_a_random_part_that_is_cut_short_keeps_the_first_result(
    monkeypatch: pytest.MonkeyPatch, untried: tuple[str, ...]
) -> None:
    workspace, base = Workspace((), None, (), (), {}), SimpleNamespace(evidence=0.0, log_likelihood=0.0)

    def searched(evidence: float, findings: tuple[Any, ...]) -> Found:
        return Found(base, base, findings, (), (), SimpleNamespace(evidence=evidence))  # type: ignore[arg-type]

    first, second = searched(1.0, (SimpleNamespace(lead=0.0),)), searched(5.0, ())
    answers = iter([first, second])

    workspace.leave("further effects")  # the first search may have left the same effects untried

    def effects(_: object, known: Explanation, how: Search) -> Found:
        found = next(answers)
        if found is second:
            how.workspace.untried.extend(untried)
        return found

    parts = iter([base])
    module = searching
    monkeypatch.setattr(module, "_effects", effects)
    monkeypatch.setattr(module, "_alone", lambda *_: NOTHING_SCORED)
    monkeypatch.setattr(module, "_outdone", lambda *_: False)
    monkeypatch.setattr(module, "absorbed", lambda *_: next(parts, None))
    found = module.search(base, Search(workspace))  # type: ignore[arg-type]
    assert found is (first if untried else second)


@pytest.mark.parametrize(("lead", "kept"), [(26.0, True), (19.0, False), (22.0, False)])
def test_only_findings_that_lead_by_more_than_a_random_part_explains_are_kept(
    monkeypatch: pytest.MonkeyPatch, lead: float, kept: bool
) -> None:
    """The random part explains 20 nats; a finding that leads by two more would have odds of 7 to 1."""

    base, wider = (SimpleNamespace(evidence=0.0, log_likelihood=each) for each in (0.0, 20.0))
    named, beside = SimpleNamespace(evidence=40.0), SimpleNamespace(evidence=50.0)
    friction = SimpleNamespace(effect="friction", lead=lead)
    first = Found(base, base, (friction,), (named,), (), named)  # type: ignore[arg-type]
    started: list[Explanation] = []

    def effects(_: object, known: Explanation, how: Search) -> Found:
        started.append(known)
        return first if len(started) == 1 else replace(first, last=beside)  # type: ignore[arg-type]

    parts, module = iter([wider]), searching
    monkeypatch.setattr(module, "_effects", effects)
    monkeypatch.setattr(module, "_alone", lambda *_: NOTHING_SCORED)
    monkeypatch.setattr(module, "_outdone", lambda *_: False)
    monkeypatch.setattr(module, "absorbed", lambda *_: next(parts, None))
    monkeypatch.setattr(module, "_with_random_part", lambda *_: beside)
    found = module.search(base, Search(Workspace((), None, (), (), {})))  # type: ignore[arg-type]
    assert found.last is beside
    assert [each.effect for each in started[1].findings] == (["friction"] if kept else [])
    assert started[1].fit is (beside if kept else wider)


def test_findings_stand_if_time_runs_out_before_they_are_fitted_with_the_random_part(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    base, wider = (SimpleNamespace(evidence=0.0, log_likelihood=each) for each in (0.0, 20.0))
    named = SimpleNamespace(evidence=40.0)
    found = Found(base, base, (SimpleNamespace(lead=90.0),), (named,), (), named)  # type: ignore[arg-type]

    def out_of_time(*_: object) -> None:
        raise OutOfTime

    workspace, module = Workspace((), None, (), (), {}), searching
    monkeypatch.setattr(module, "_effects", lambda *_: found)
    monkeypatch.setattr(module, "_alone", lambda *_: NOTHING_SCORED)
    monkeypatch.setattr(module, "_outdone", lambda *_: False)
    monkeypatch.setattr(module, "absorbed", lambda *_: wider)
    monkeypatch.setattr(module, "_with_random_part", out_of_time)
    assert module.search(base, Search(workspace)) is found  # type: ignore[arg-type]
    assert workspace.untried == [RANDOM]
