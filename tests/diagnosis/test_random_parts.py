"""The random parts beside the first-order disturbance: how they are made, estimated and told apart from effects."""

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

import diagnosis.search.search
from benchmarks.others_recordings import EFFECTS, SENSORS, OthersVehicle
from diagnosis.diagnose import Diagnosis, Verdict, diagnose
from diagnosis.lack_of_fit.colour import LEVEL, _blocks, signals
from diagnosis.prepare.ready import ready
from diagnosis.prepare.workspace import Workspace
from diagnosis.report.sentences import disturbance_sentences, to_within
from diagnosis.search.explanation import Explanation, Search
from diagnosis.search.search import Found
from estimators.disturbance_estimate import DisturbanceEstimate, NarrowBandEstimate
from estimators.fit.disturbance import disturbances
from estimators.fit.maximum_likelihood import fit
from estimators.fit.problem import problem
from estimators.identify.run import with_values
from estimators.methods.prediction_error import prediction_error
from models.file.model_file import parse, read
from models.file.model_file import write as write_model
from models.model import Model
from models.parts import Disturbance, ModelError
from models.parts import NarrowBand as KnownBand
from models.random.disturbance import at_joints, disturbed, undisturbed, with_narrow_band
from service.offline.replay import load as load_recording
from service.virtual.run import record
from simulation.monocab.hidden import MONOCAB
from simulation.narrow_band import NarrowBand, NarrowBandTorque
from simulation.registry import UnknownEffectError, parse_narrow_band
from telemetry.recording import Recording
from vehicles.file import load
from vehicles.registry import nominal_model

VEHICLE = load("monocab")
NOMINAL = with_values(nominal_model("monocab"), VEHICLE.parameters.values, VEHICLE.parameters.deviations).remove(
    "static_torque"
)
STEP = 1.0 / 3000.0
"""s, the plant's at 250 Hz."""
MOST = 4.0
"""Standard deviations of an estimate that a test allows: 6 of 100,000 seeds are beyond."""


# --- the virtual vehicle's


def test_it_has_its_rms_its_frequency_and_its_damping_ratio() -> None:
    """Its autocorrelation is rms^2 exp(-z w t) (cos(w' t) + z sin(w' t) w / w'), w' = w sqrt(1 - z^2); estimates over D
    s scatter as those of as many independent values as D z w / 2 at least."""
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


def test_it_is_stationary_from_the_first_step_on_and_follows_from_the_seed() -> None:
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
def test_it_is_asked_for_as_an_effect_is(argument: str, expected: NarrowBand | None) -> None:
    assert parse_narrow_band(["coulomb_friction=2", argument], MONOCAB) == (["coulomb_friction=2"], expected)


@pytest.mark.parametrize("argument", ["narrow_band=3,2", "narrow_band=-1,2,0.1", "narrow_band=3,2,1", "narrow_band=x"])
def test_one_that_cannot_be_is_refused_with_the_remedy(argument: str) -> None:
    with pytest.raises(UnknownEffectError, match=r"narrow_band=4,2,0\.05.*narrow_band=0 switches it off"):
        parse_narrow_band([argument], MONOCAB)


@pytest.mark.parametrize(("vehicle", "channel"), [("monocab", "roll"), ("twsbr", "tilt")])
def test_it_shakes_the_virtual_vehicles(vehicle: str, channel: str) -> None:
    shaken, still = (record(vehicle, "hold", hide=hide, seed=3, duration=5.0) for hide in (["narrow_band"], []))
    assert not np.array_equal(shaken.values[channel], still.values[channel])


# --- in fits


def shaken(band: NarrowBand, seed: int, seconds: float = 30.0) -> Recording:
    """Of the tests' own vehicle, beside 8 N m RMS of the first order."""
    random = NarrowBandTorque(band, 1e-3, seed + 100)
    return Shaken(more=lambda time, roll, rate: random.torque(time)).record(seed, seconds)


def with_one(record: Recording, frequency: float, seconds: float) -> Model:
    model = disturbed(NOMINAL, [record])
    ((joint, _),) = at_joints(model)
    return with_narrow_band(model, joint.name, KnownBand(frequency), seconds)


def test_its_rms_its_frequency_and_its_damping_ratio_are_estimated() -> None:
    """Of their 95 % intervals, in logarithms, no fewer hold the truth than chance leaves of 20."""
    band, held = NarrowBand(6.0, 2.0, 0.05), np.zeros(3)
    for seed in range(20):
        record = shaken(band, seed, 60.0)
        model = with_one(record, 2.3, 60.0)
        (found,) = disturbances(fit(problem(model, [record], support=VEHICLE.support)))
        told = found.narrow_band
        assert told is not None
        values = np.array([told.std, told.frequency, told.damping])
        errors = np.array([told.std_error, told.frequency_error, told.damping_error])
        held += np.abs(np.log(values / [band.rms, band.frequency, band.damping])) < 1.96 * errors / values
    assert np.all(held >= binom.ppf(1e-3, 20, 0.95)), held


def test_it_is_of_a_record_and_no_part_of_the_machine() -> None:
    record = shaken(NarrowBand(4.0, 2.0, 0.05), 1)
    model = with_one(record, 2.0, 30.0)
    assert len(model.base_states) == len(NOMINAL.base_states) + 3
    left = undisturbed(NOMINAL, model)
    assert (left.base_states, left.base_parameters, left.joints) == (
        NOMINAL.base_states,
        NOMINAL.base_parameters,
        NOMINAL.joints,
    )


TOLD = NarrowBandEstimate("N m", 3.0, 0.2, 2.1, 0.03, 0.05, 0.01)


@pytest.mark.parametrize(
    ("shown", "said"),
    [
        (True, "8.1 ± 0.4 N m RMS, correlation time 0.31 ± 0.03 s, and 3.0 ± 0.2 N m RMS about 2.10 ± 0.03 Hz"),
        (False, "3.0 ± 0.2 N m RMS about 2.10 ± 0.03 Hz"),
    ],
)
def test_it_is_told_beside_the_first(shown: bool, said: str) -> None:
    errors = (0.4, 0.31, 0.03) if shown else (None, None, None)
    found = DisturbanceEstimate("roll", "N m", 8.1, *errors, shown=shown, narrow_band=TOLD)
    assert f"{found}".startswith(said)
    assert f"{found}".endswith("damping ratio 0.050 ± 0.010")
    assert DisturbanceEstimate.from_json("roll", found.to_json()) == found


# --- in the diagnosis


def diagnosed(record: Recording) -> Diagnosis:
    return diagnose(NOMINAL, [record], support=VEHICLE.support)


def virtual(*hide: str, seed: int = 1) -> Recording:
    return record("monocab", "multisine", hide=["disturbance", *hide], seed=seed)


def holds(found: Diagnosis, band: NarrowBand) -> bool:
    told = found.disturbance[0].narrow_band
    return told is not None and all(
        abs(value - truth) < 3.0 * error
        for value, error, truth in (
            (told.std, told.std_error, band.rms),
            (told.frequency, told.frequency_error, band.frequency),
            (told.damping, told.damping_error, band.damping),
        )
    )


def test_nothing_is_missing_but_a_random_torque_about_a_frequency() -> None:
    found = diagnosed(virtual("narrow_band"))
    assert found.verdict is Verdict.ADEQUATE
    assert holds(found, MONOCAB.narrow_band)
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
def test_effects_stay_effects(hide: tuple[str, ...], narrow: bool) -> None:
    found = diagnosed(virtual(*hide))
    assert [each.effect for each in found.findings] == list(hide[-1:])
    assert (found.disturbance[0].narrow_band is not None) is narrow


def test_what_is_periodic_and_what_is_random_are_told_apart() -> None:
    random = NarrowBandTorque(NarrowBand(6.0, 3.0, 0.05), 1e-3, 102)
    record = Shaken(
        more=lambda time, roll, rate: random.torque(time) + 15.0 * math.sin(2.0 * math.pi * 1.3 * time)
    ).record(2)
    found = diagnosed(record)
    assert [each.effect for each in found.findings] == ["periodic_disturbance"]
    assert holds(found, NarrowBand(6.0, 3.0, 0.05))


def test_what_is_white_has_no_peak() -> None:
    """Of 300 white signals, at the level of 1 %, no more than chance gives have one."""
    random, wrong = np.random.default_rng(8), 0
    for _ in range(300):
        lines = np.fft.rfft(random.standard_normal(2000))[1:-1]
        blocks = list(_blocks(np.abs(lines) ** 2 / 2000))
        wrong += min(blocks)[0] < LEVEL / len(blocks)
    assert wrong <= binom.ppf(0.999, 300, LEVEL)


def test_where_there_is_none_nothing_is_fitted() -> None:
    """At the level of 1 % a virtual vehicle without has no peak."""
    record = virtual()
    assert not signals(fit(problem(ready(NOMINAL, [record]), [record], support=VEHICLE.support)))


# --- errors of sensors


def others(tmp_path: Path, sensor: str, seed: int = 11, **more: Any) -> Recording:
    """Of a vehicle apart from the virtual one, shaken by 8 N m RMS for 0.3 s, with that error of its sensors."""
    vehicle = OthersVehicle(sensors=SENSORS[sensor], disturbance=(8.0, 0.3), seed=seed, **more)
    return load_recording(vehicle.write(tmp_path / f"{sensor}.csv"), VEHICLE)


def held_by(found: float, error: float, truth: float) -> bool:
    return abs(math.log(found / truth)) < MOST * error / found


@pytest.mark.parametrize("sensor", ["wander", "vibration"])
def test_an_error_of_the_gyro_is_told_and_takes_nothing_else_s_place(tmp_path: Path, sensor: str) -> None:
    found = diagnosed(others(tmp_path, sensor))
    assert found.verdict is Verdict.ADEQUATE
    (told,) = found.sensor_errors
    assert told.channel == "roll_rate"
    (shaking,) = found.disturbance
    assert held_by(shaking.std, shaking.std_error or 0.0, 8.0)
    assert found.revised is not None
    assert [each.expression for each in found.revised.outputs] == [each.expression for each in NOMINAL.outputs]
    assert "roll_rate" in disturbance_sentences(found)
    assert found.to_json()["sensor_errors"]["roll_rate"]["unit"] == "rad/s"
    if sensor == "wander":
        rms, time = SENSORS[sensor].wander
        assert held_by(told.std, told.std_error, rms)
        assert held_by(told.correlation_time, told.correlation_time_error, time)
    else:
        rms, frequency, _ = SENSORS[sensor].vibration
        assert told.narrow_band is not None
        assert held_by(told.narrow_band.std, told.narrow_band.std_error, rms)
        # Where between displacement and velocity of the mode the gyro stands bends the peak a little.
        assert told.narrow_band.frequency == pytest.approx(frequency, rel=0.03)


def test_an_encoder_makes_none(tmp_path: Path) -> None:
    found = diagnosed(others(tmp_path, "encoder"))
    assert found.verdict is Verdict.ADEQUATE
    assert not found.sensor_errors


@pytest.mark.thorough
def test_an_effect_is_found_beside_one(tmp_path: Path) -> None:
    found = diagnosed(others(tmp_path, "wander", **EFFECTS["viscous_friction"]))
    assert [each.effect for each in found.findings] == ["viscous_friction"]
    assert [each.channel for each in found.sensor_errors] == ["roll_rate"]


def test_a_narrow_band_can_be_stated(tmp_path: Path) -> None:
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
    assert held_by(found.narrow_band.std, found.narrow_band.std_error, 6.0)
    with pytest.raises(ModelError, match=r"damping_ratio: 0\.3 is too large.*give 0\.16 at most"):
        parse(text.replace("0.1 ", "0.3 "), "track.toml")


@pytest.mark.parametrize("untried", [(), ("further effects",)])
def test_a_search_beside_a_random_part_that_time_cuts_short_keeps_what_was_found(
    monkeypatch: pytest.MonkeyPatch, untried: tuple[str, ...]
) -> None:
    workspace, base = Workspace((), None, (), (), {}), SimpleNamespace(evidence=0.0, log_likelihood=0.0)

    def searched(evidence: float, findings: tuple[Any, ...]) -> Found:
        return Found(base, base, findings, (), (), SimpleNamespace(evidence=evidence))  # type: ignore[arg-type]

    first, second = searched(1.0, (SimpleNamespace(lead=0.0),)), searched(5.0, ())
    answers = iter([first, second])

    workspace.leave("further effects")  # the first search may have left the same

    def effects(_: object, known: Explanation, how: Search) -> Found:
        found = next(answers)
        if found is second:
            how.workspace.untried.extend(untried)
        return found

    parts = iter([base])
    module = diagnosis.search.search
    monkeypatch.setattr(module, "_effects", effects)
    monkeypatch.setattr(module, "_outdone", lambda *_: False)
    monkeypatch.setattr(module, "absorbed", lambda *_: next(parts, None))
    found = module.search(base, Search(workspace))  # type: ignore[arg-type]
    assert found is (first if untried else second)


@pytest.mark.parametrize(("lead", "kept"), [(26.0, True), (19.0, False), (22.0, False)])
def test_findings_that_lead_by_more_than_a_random_part_explains_are_not_searched_for_again(
    monkeypatch: pytest.MonkeyPatch, lead: float, kept: bool
) -> None:
    """The part explains 20 nats; what leads by two more would have odds of 7 to 1."""

    base, wider = (SimpleNamespace(evidence=0.0, log_likelihood=each) for each in (0.0, 20.0))
    named, beside = SimpleNamespace(evidence=40.0), SimpleNamespace(evidence=50.0)
    friction = SimpleNamespace(effect="friction", lead=lead)
    first = Found(base, base, (friction,), (named,), (), named)  # type: ignore[arg-type]
    started: list[Explanation] = []

    def effects(_: object, known: Explanation, how: Search) -> Found:
        started.append(known)
        return first if len(started) == 1 else replace(first, last=beside)  # type: ignore[arg-type]

    parts, module = iter([wider]), diagnosis.search.search
    monkeypatch.setattr(module, "_effects", effects)
    monkeypatch.setattr(module, "_outdone", lambda *_: False)
    monkeypatch.setattr(module, "absorbed", lambda *_: next(parts, None))
    monkeypatch.setattr(module, "_with_random_part", lambda *_: beside)
    found = module.search(base, Search(Workspace((), None, (), (), {})))  # type: ignore[arg-type]
    assert found.last is beside
    assert [each.effect for each in started[1].findings] == (["friction"] if kept else [])
    assert started[1].fit is (beside if kept else wider)
