"""The random disturbance of a virtual vehicle: its statistics, its own random numbers, and how it is requested."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import hidden_effects_stand_in as stand_in
import numpy as np
import pytest
from plant_in_the_loop import ClosedLoopRun, Measured, simulate_closed_loop
from typer.testing import CliRunner

from upright.service.cli import app
from upright.service.hidden_effects.cases import Case
from upright.service.hidden_effects.disturbances import Drawn, Multiple, parse_disturbances, sensor_floor
from upright.service.hidden_effects.methods.answers import ADEQUATE, Answer
from upright.service.hidden_effects.results.by_disturbance import thirds
from upright.service.hidden_effects.results.summary import summarise
from upright.service.hidden_effects.trial import SUBJECT, Bench, virtual
from upright.service.hidden_effects.trial import run as run_case
from upright.service.hidden_effects.vehicles import drawn
from upright.service.virtual import vehicle as virtual_vehicle
from upright.service.virtual.run import record
from upright.simulation.config import ImuNode, SimulationConfig
from upright.simulation.monocab.hidden import MONOCAB
from upright.simulation.monocab.plant import Plant
from upright.simulation.monocab.truth import PlantTruth
from upright.simulation.physics.disturbance import Disturbance, RandomTorque
from upright.simulation.registry import UnknownEffectError, parse_disturbance, parse_hidden
from upright.simulation.twsbr.hidden import TWSBR
from upright.simulation.twsbr.plant import TwsbrPlant
from upright.simulation.twsbr.truth import TwsbrTruth
from upright.telemetry.recording import Recording
from upright.vehicles import registry as vehicles_registry
from upright.vehicles.file import load
from upright.vehicles.registry import nominal_model

STEP = 1.0 / 3000.0
"""s, the plant's at 250 Hz."""
MAX_SIGMAS = 4.0
"""Tolerance of an estimate, in its standard deviations: 6 of 100,000 seeds exceed it."""


def realisation(disturbance: Disturbance, seconds: float, *, step: float = STEP, seed: int = 5) -> np.ndarray:
    torque = RandomTorque(disturbance, step, seed)
    return np.array([torque.torque(0.0) for _ in range(round(seconds / step))])


# --- its statistics


@pytest.mark.parametrize(("rms", "correlation_time"), [(2.0, 0.05), (8.0, 0.3), (20.0, 0.3)])
def test_disturbance_has_the_given_rms_and_correlation_time(rms: float, correlation_time: float) -> None:
    """The variances of the estimates are those of a Gaussian process with this autocorrelation over the duration D:
    T / (2 D) of the relative RMS, Bartlett's (1 - 3 exp(-2)) T / D of the autocorrelation at the lag T, and
    2 T / D of the mean over the RMS; T is the correlation time."""
    duration = 1000.0 * correlation_time
    torque = realisation(Disturbance(rms, correlation_time), duration)
    samples = duration / correlation_time
    measured = math.sqrt(float(np.mean(torque**2)))
    assert measured == pytest.approx(rms, rel=MAX_SIGMAS * math.sqrt(0.5 / samples))
    assert abs(float(np.mean(torque))) < MAX_SIGMAS * rms * math.sqrt(2.0 / samples)
    lag = round(correlation_time / STEP)
    correlation = float(np.mean(torque[lag:] * torque[:-lag])) / measured**2
    within = MAX_SIGMAS * math.sqrt((1.0 - 3.0 * math.exp(-2.0)) / samples)
    assert correlation == pytest.approx(math.exp(-1.0), abs=within)


def test_disturbance_is_stationary_from_the_first_step() -> None:
    """The first values of many seeds already have the given RMS."""
    first = [RandomTorque(Disturbance(8.0, 3.0), STEP, seed).torque(0.0) for seed in range(400)]
    assert math.sqrt(float(np.mean(np.square(first)))) == pytest.approx(8.0, rel=MAX_SIGMAS * math.sqrt(0.5 / 400))


def test_coarse_step_preserves_rms_and_autocorrelation() -> None:
    """The discretisation is exact, even if a step is twice the correlation time."""
    coarse = realisation(Disturbance(8.0, 0.3), 3000.0, step=0.6)
    assert math.sqrt(float(np.mean(coarse**2))) == pytest.approx(8.0, rel=MAX_SIGMAS * math.sqrt(0.5 / len(coarse)))
    correlation = float(np.mean(coarse[1:] * coarse[:-1])) / 64.0
    assert correlation == pytest.approx(math.exp(-2.0), abs=MAX_SIGMAS / math.sqrt(len(coarse)))


def test_same_seed_repeats_the_torque_and_another_seed_changes_it() -> None:
    one, again, other = (realisation(Disturbance(8.0, 0.3), 1.0, seed=seed) for seed in (5, 5, 6))
    assert np.array_equal(one, again)
    assert not np.any(one == other)


# --- in the vehicles


def hold(measured: Measured) -> tuple[float, float]:
    """Balances with measured values alone; the angle of the specific force is accurate enough for half a second."""
    _, y, z = measured.sample.acceleration
    return min(1.0, max(-1.0, -18.0 * math.atan2(y, z) - 5.0 * measured.sample.angular_rate[0])), 0.0


def run(disturbance: Disturbance | None, seconds: float = 1.0) -> ClosedLoopRun:
    return simulate_closed_loop(
        SimulationConfig(PlantTruth(), disturbance=disturbance, seed=9), hold, seconds, roll=0.0
    )


def test_disturbance_accelerates_the_monocab_as_a_torque_does() -> None:
    """Upright with closed brakes, over the first 20 ms: the roll rate is the integral of torque over inertia."""
    disturbance = Disturbance(8.0, 0.3)
    config = SimulationConfig(PlantTruth(), disturbance=disturbance, seed=9)
    plant = Plant(config)
    plant.place(0.0)
    plant.advance(60)
    torque = RandomTorque(disturbance, config.step, 9)
    # The first value is in the acceleration that `place` sets; velocity Verlet uses the mean of both ends of a step.
    values = np.array([torque.torque(0.0) for _ in range(61)])
    expected = config.step * float(np.sum(0.5 * (values[1:] + values[:-1]))) / 1650.0
    assert plant.roll_rate == pytest.approx(expected, rel=2e-3)


def test_sensor_noise_is_the_same_with_and_without_a_disturbance() -> None:
    still, shaken = run(None), run(Disturbance(8.0, 0.3))
    assert np.abs(shaken.true_roll - still.true_roll)[-1] > 1e-5
    noise = [each.angular_rate[:, 0] - each.true_roll_rate for each in (still, shaken)]
    assert noise[0] == pytest.approx(noise[1], abs=1e-14)
    assert np.array_equal(still.angular_rate[:, 1:], shaken.angular_rate[:, 1:])


def test_disturbance_changes_nothing_before_its_onset() -> None:
    still, late = run(None), run(Disturbance(8.0, 0.3, onset=0.5))
    changed = np.flatnonzero(late.true_roll != still.true_roll)[0] / 250.0
    assert 0.49 < changed < 0.52


def test_record_with_the_disturbance_switched_off_is_unchanged() -> None:
    """Bit for bit, from the arguments of the command line to the recorded values."""
    off, none, on = (
        record("monocab", "hold", hide=hide, seed=3, duration=5.0)
        for hide in (["disturbance=0"], [], ["disturbance=8,0.3"])
    )
    for name in none.values:
        assert np.array_equal(off.values[name], none.values[name], equal_nan=True)
    assert not np.array_equal(on.values["roll"], none.values["roll"])
    assert "disturbance=8,0.3" in on.source


def test_restarted_disturbance_does_not_depend_on_the_time_before() -> None:
    """On the bus, a record depends on the seed alone, not on how long the set-up of the drives took."""
    plants = [Plant(SimulationConfig(PlantTruth(), disturbance=Disturbance(8.0, 0.3))) for _ in range(2)]
    for plant, before in zip(plants, (10, 137), strict=True):
        plant.advance(before)
        plant.event_origin = plant.time
        plant.restart_disturbance()
        plant.place(0.0)
        plant.advance(100)
    assert plants[0].roll == plants[1].roll


def test_disturbance_tilts_the_robot_as_a_torque_does() -> None:
    """Upright with open bridges, after 10 ms, compared with the same robot under the mean torque as a static one."""
    disturbance = Disturbance(0.01, 3.0)
    shaken = TwsbrPlant(SimulationConfig(plant=TwsbrTruth(), disturbance=disturbance, seed=4))
    torque = RandomTorque(disturbance, shaken.step_size, 4)
    steps = round(0.01 / shaken.step_size)
    mean = float(np.mean([torque.torque(0.0) for _ in range(steps)]))
    level = mean / TWSBR.listed["static_torque"].size
    pushed = TwsbrPlant(SimulationConfig(plant=TwsbrTruth(), hidden={"static_torque": level}, seed=4))
    for plant in (shaken, pushed):
        plant.place(0.0)
        plant.advance(steps)
    assert shaken.tilt_rate == pytest.approx(pushed.tilt_rate, rel=0.01)


def test_default_disturbance_of_the_robot_changes_its_tilt() -> None:
    shaken, still = (record("twsbr", "hold", hide=hide, seed=3, duration=6.0) for hide in (["disturbance"], []))
    assert not np.array_equal(shaken.values["tilt"], still.values["tilt"])


# --- how it is requested


@pytest.mark.parametrize(
    ("argument", "expected"),
    [
        ("disturbance", Disturbance(8.0, 0.3)),
        ("disturbance=0.5", Disturbance(4.0, 0.3)),
        ("disturbance=12,0.05", Disturbance(12.0, 0.05)),
        ("disturbance=12,0.05@30", Disturbance(12.0, 0.05, onset=30.0)),
        ("disturbance@5", Disturbance(8.0, 0.3, onset=5.0)),
        ("disturbance=0", None),
        ("disturbance=0,1", None),
    ],
)
def test_disturbance_is_requested_like_an_effect(argument: str, expected: Disturbance | None) -> None:
    others, found = parse_disturbance(["coulomb_friction=2", argument], MONOCAB, Disturbance(1.0, 1.0))
    assert found == expected
    assert parse_hidden(others, MONOCAB) == ({"coulomb_friction": 2.0}, {})


def test_default_disturbance_applies_unless_one_is_requested() -> None:
    usual = Disturbance(1.0, 1.0)
    assert parse_disturbance(["coulomb_friction"], MONOCAB, usual) == (["coulomb_friction"], usual)
    assert parse_disturbance([], MONOCAB) == ([], None)
    assert parse_disturbance(["disturbance=0", "disturbance=2,1"], MONOCAB)[1] == Disturbance(2.0, 1.0)


@pytest.mark.parametrize(
    ("argument", "what"),
    [
        ("disturbance=much", "'disturbance=much' is not a disturbance"),
        ("disturbance=", "is not a disturbance"),
        ("disturbance=8,0.3,1", "is not a disturbance"),
        ("disturbance=8,", "is not a disturbance"),
        ("disturbance=-1", "the RMS of the disturbance cannot be -8 N m"),
        ("disturbance=nan,1", "the RMS of the disturbance cannot be nan N m"),
        ("disturbance=8,0", "the correlation time of the disturbance cannot be 0 s"),
        ("disturbance=8,inf", "the correlation time of the disturbance cannot be inf s"),
        ("disturbance=8,0.3@-1", "the disturbance cannot set in at -1 s"),
        ("disturbance@soon", "is not a disturbance"),
    ],
)
def test_invalid_disturbance_is_refused_with_the_remedy(argument: str, what: str) -> None:
    with pytest.raises(UnknownEffectError, match=r"disturbance=8,0\.3.*disturbance=0 switches it off") as caught:
        parse_disturbance([argument], MONOCAB)
    assert what in str(caught.value)
    assert caught.value.name == "disturbance"


def test_unknown_effect_error_lists_the_disturbance_too() -> None:
    with pytest.raises(UnknownEffectError, match="sensor_scale, disturbance"):
        parse_hidden(["disturbances"], MONOCAB)


def test_configuration_has_no_disturbance_unless_requested() -> None:
    vehicle = load("monocab")
    assert virtual_vehicle.configuration(vehicle, [], 1).disturbance is None
    assert virtual_vehicle.configuration(vehicle, ["disturbance"], 1).disturbance == MONOCAB.disturbance
    given = Disturbance(3.0, 1.0)
    assert virtual_vehicle.configuration(vehicle, [], 1, disturbance=given).disturbance == given
    assert virtual_vehicle.configuration(vehicle, ["disturbance=0"], 1, disturbance=given).disturbance is None


@pytest.mark.parametrize("vehicle", ["monocab", "twsbr"])
def test_vehicle_started_by_a_user_has_the_default_disturbance(vehicle: str) -> None:
    file = load(vehicle)
    registry = vehicles_registry.of(vehicle).twin().truth.registry
    assert any(joint.disturbance is not None for joint in nominal_model(vehicle).joints)
    for hide in ([], ["static_torque"]):
        assert virtual_vehicle.requested_disturbance(file, hide) == registry.disturbance
    assert virtual_vehicle.requested_disturbance(file, ["disturbance=0"]) is None
    assert virtual_vehicle.requested_disturbance(file, ["disturbance"]) == registry.disturbance


@pytest.mark.parametrize("words", [["demo"], ["serve", "monocab", "--virtual"], ["simulate", "monocab"]])
def test_commands_refuse_an_invalid_disturbance(words: list[str]) -> None:
    result = CliRunner().invoke(app, [*words, "--hide", "disturbance=8,x"])
    assert result.exit_code != 0
    assert isinstance(result.exception, UnknownEffectError) or "is not a disturbance" in result.output


# --- in the benchmark


def floor(correlation_time: float) -> float:
    return sensor_floor(PlantTruth(), ImuNode(), correlation_time)


@pytest.mark.parametrize("truth", [PlantTruth(), TwsbrTruth()])
def test_sensor_floor_is_the_rms_torque_due_to_gyro_noise_alone(truth: PlantTruth | TwsbrTruth) -> None:
    """The slope of its white noise by least squares, over many windows of one correlation time each."""
    imu, correlation_time, count = ImuNode(), 0.4, 4000
    time = np.arange(100) * correlation_time / 100
    deviation = imu.angular_rate_density * math.sqrt(0.5 / (time[1] - time[0]))
    noise = np.random.default_rng(3).normal(0.0, deviation, (count, len(time)))
    centred = time - time.mean()
    torques = truth.falling_inertia * noise @ centred / float(centred @ centred)
    expected = sensor_floor(truth, imu, correlation_time)
    assert float(np.std(torques)) == pytest.approx(expected, rel=MAX_SIGMAS * math.sqrt(0.5 / count))


def test_falling_inertia_is_the_one_that_a_tilt_torque_accelerates() -> None:
    """Compared with the robot itself, released upright with open bridges."""
    level = 1.0e-3 / TWSBR.listed["static_torque"].size
    plant = TwsbrPlant(SimulationConfig(plant=TwsbrTruth(), hidden={"static_torque": level}))
    plant.place(0.0)
    plant.advance(2)
    assert 1.0e-3 * plant.time / plant.tilt_rate == pytest.approx(TwsbrTruth().falling_inertia, rel=0.01)


def test_drawn_disturbances_are_log_uniform_and_determined_by_the_seed() -> None:
    found = [Drawn().of(seed, floor) for seed in range(400)]
    assert found[7] == Drawn().of(7, floor)
    for values, (low, high) in (
        ([each.rms for each in found], (2.0, 20.0)),
        ([each.correlation_time for each in found], (0.05, 3.0)),
    ):
        shares = np.log(np.array(values) / low) / math.log(high / low)
        assert shares.min() >= -1e-5
        assert shares.max() <= 1.0 + 1e-5
        # Kolmogorov-Smirnov: the distance exceeds 1.95 / sqrt(n) for 0.1 % of uniform samples.
        ranks = (np.arange(len(shares)) + 0.5) / len(shares)
        assert float(np.max(np.abs(np.sort(shares) - ranks))) < 1.95 / math.sqrt(len(shares))
    middle = Drawn().of(None, floor)
    assert (middle.rms, middle.correlation_time) == pytest.approx((math.sqrt(40.0), math.sqrt(0.15)), rel=1e-5)


def test_multiple_of_the_sensor_floor_is_the_same_in_every_record() -> None:
    requested = parse_disturbances("10,0.3", Drawn())
    assert requested == Multiple(10.0, 0.3)
    assert requested.of(1, floor) == requested.of(None, floor)
    assert requested.of(1, floor).rms == pytest.approx(10.0 * 1650.0 * 3.5e-5 * math.sqrt(6.0 / 0.3**3), rel=1e-5)
    assert parse_disturbances("none", Drawn()) is None
    assert parse_disturbances(None, Drawn()) == Drawn()


@pytest.mark.parametrize("text", ["", "10", "10,0", "-1,0.3", "a,b", "10,0.3,1", "nan,1"])
def test_invalid_multiple_is_refused(text: str) -> None:
    with pytest.raises(ValueError, match=r"RMS,CORRELATION_TIME, both above 0, .* as in 10,0\.3, nor none"):
        parse_disturbances(text, Drawn())
    shown = CliRunner().invoke(
        app, ["benchmark", "hidden-effects", "--disturbance", text], env={"COLUMNS": "300", "TERM": "dumb"}
    )
    assert shown.exit_code == 2
    assert "RMS,CORRELATION_TIME" in shown.output


CASES = [Case(("coulomb_friction",), 2.0, noise, "multisine", number) for noise in (1.0, 3.0) for number in range(2)]


def test_line_of_a_case_reports_its_disturbance() -> None:
    """It differs between cases, is the same in both records of a case, and its floor scales with the sensor noise."""
    requested: list[str] = []

    def keep(*case: Any) -> Recording:
        requested.append(stand_in.labelled(*case).metadata["disturbance"])
        return stand_in.labelled(*case)

    bench = Bench(methods={}, record=keep, disturbances=Drawn())
    lines = [run_case(case, bench, {"coulomb_friction": 1.0}) for case in CASES]
    reported = [line["disturbance"] for line in lines]
    assert len({each["rms"] for each in reported}) == len(CASES)
    assert requested[0::2] == requested[1::2]
    assert requested[::2] == [str(Disturbance(each["rms"], each["correlation_time"])) for each in reported]
    for case, each in zip(CASES, reported, strict=True):
        least = case.noise * floor(each["correlation_time"])
        assert each["over_floor"] == pytest.approx(each["rms"] / least)
    reference = run_case(CASES[0].reference, bench, {})
    assert reference["disturbance"]["rms"] == pytest.approx(math.sqrt(40.0), rel=1e-5)


def test_amplitudes_are_multiples_of_those_detectable_under_the_disturbance() -> None:
    hidden_in: list[dict[str, float]] = []

    def keep(*case: Any) -> Recording:
        hidden_in.append(dict(case[1]))
        return stand_in.labelled(*case)

    def detecting_method(*_: Any, **__: Any) -> Answer:
        return Answer(ADEQUATE, detectable={"coulomb_friction": 0.5}, disturbance={"rms": (1e6, 1.0)})

    bench = Bench(methods={SUBJECT: detecting_method}, record=keep, disturbances=Drawn())
    line = run_case(CASES[0], bench, {"coulomb_friction": 1e3})
    assert hidden_in[0] == {}
    assert abs(line["sizes"]["coulomb_friction"]) == pytest.approx(2.0 * 0.5)
    assert line["methods"][SUBJECT]["disturbance_covered"] == {"rms": False}


def test_without_a_disturbance_conditions_and_records_are_unchanged() -> None:
    still = Bench(methods={}, record=stand_in.labelled)
    assert still.conditions == "monocab_roll, 30 s, vehicles as far off as their file says"
    assert "2 to 20 N m RMS and 0.05 to 3 s" in replace(still, disturbances=Drawn()).conditions
    assert "of 10 sensor floors and 0.3 s" in replace(still, disturbances=Multiple(10.0, 0.3)).conditions
    line = run_case(CASES[0], still, {"coulomb_friction": 1.0})
    assert line["disturbance"] is None
    one, other = (
        virtual("hold", {"coulomb_friction": 2.0}, 1.0, 3.0, 7, drawn(7), *rest)
        for rest in ((), (Disturbance(8, 0.3),))
    )
    assert "disturbance" not in one.source
    assert "disturbance=8,0.3" in other.source
    assert not np.array_equal(one.values["roll"], other.values["roll"])


def line_of(rms: float | None, verdict: str, **changes: Any) -> dict[str, Any]:
    reported = {"verdict": verdict, "found": [], "covered": {}, "seconds": 1.0, "error": ""}
    line = {"key": f"{rms}", "kind": "nothing", "effects": [], "size": 0.0, "noise": 1.0, "excitation": "hold"}
    line |= {"status": "ok", "conditions": "x", "methods": {"m": reported}}
    if rms is not None:
        line["disturbance"] = {"rms": rms, "correlation_time": 0.3, "over_floor": 1.0}
    return {**line, **changes}


def test_false_alarms_are_summarised_by_thirds_of_the_rms() -> None:
    lines = [line_of(rms, "unknown" if rms > 12.0 else "adequate") for rms in (20.0, 2.0, 3.0, 6.0, 9.0, 18.0)]
    summary = summarise(lines)
    alarms = summary.methods["m"].false_alarms_by_disturbance
    assert {part: (figure.count, figure.of) for part, figure in alarms.items()} == {
        "2 to 3 N m": (0, 2),
        "6 to 9 N m": (0, 2),
        "18 to 20 N m": (2, 2),
    }
    assert list(summary.to_json()["methods"]["m"]["false_alarms_by_disturbance"]) == list(alarms)
    assert list(thirds([line_of(8.6, "adequate"), line_of(None, "adequate")])) == ["none", "8.6 N m"]


def test_results_file_without_disturbances_is_shown_without_them(tmp_path: Path) -> None:
    old = line_of(None, "adequate")
    path = tmp_path / "old.jsonl"
    path.write_text(json.dumps(old) + "\n")
    shown = CliRunner().invoke(app, ["benchmark", "hidden-effects", "--summary", str(path)])
    assert shown.exit_code == 0, shown.output
    assert "with disturbance" not in shown.output
    path.write_text(json.dumps(line_of(8.6, "adequate")) + "\n")
    shown = CliRunner().invoke(app, ["benchmark", "hidden-effects", "--summary", str(path)])
    assert "with disturbance 8.6 N m" in shown.output
