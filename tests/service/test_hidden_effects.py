"""The benchmark of hidden effects: its cases, that no finished case is lost, its records and its command."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import dask_scheduler
import hidden_effects_stand_in as stand_in
import numpy as np
import pytest
from dask_scheduler import environment, until
from typer.testing import CliRunner

from upright.models.effects.catalogue import CATALOGUE
from upright.models.file.effect_rules import validate
from upright.models.library import get
from upright.service.cli import app
from upright.service.hidden_effects.benchmark import benchmark
from upright.service.hidden_effects.cases import QUICK, Case, Grid, Kind
from upright.service.hidden_effects.methods.answers import MISSING, Answer
from upright.service.hidden_effects.methods.baselines import BASELINES
from upright.service.hidden_effects.methods.terms import measured, regression
from upright.service.hidden_effects.results import trials as results
from upright.service.hidden_effects.results.confusion_picture import save_confusion
from upright.service.hidden_effects.results.summary import summarise
from upright.service.hidden_effects.revision import fitted
from upright.service.hidden_effects.sizes import NotDetectableError, levels, plant_sizes, right_model
from upright.service.hidden_effects.trial import SUBJECT, Bench, run, virtual
from upright.service.hidden_effects.unlisted import UNLISTED_EFFECTS
from upright.service.hidden_effects.vehicles import FARTHEST, LATENCY, drawn
from upright.service.spread import SchedulerError, Spread, machines, processes
from upright.simulation.monocab.hidden import HIDDEN, MONOCAB, UNLISTED
from upright.simulation.monocab.roll_effects import roll_effects
from upright.simulation.monocab.truth import PlantTruth
from upright.simulation.registry import UnknownEffectError, sizes_of
from upright.telemetry.recording import Recording
from upright.vehicles.file import load

pytestmark = pytest.mark.timeout(300)
"""Each of many worker processes imports numpy and SciPy; on a busy machine that takes a minute per test."""

TESTS = Path(__file__).resolve().parents[1] / "support"
CASE = Case(("coulomb_friction",), 2.0, 1.0, "multisine", 0)


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with a subfolder in which the stand-ins record their calls."""
    traces = tmp_path / "traces"
    traces.mkdir()
    monkeypatch.setenv(stand_in.FOLDER, str(traces))
    return tmp_path


# --- the cases


def test_keys_and_seeds_of_cases_never_change() -> None:
    """They match results from other days and machines."""
    assert CASE.key == "coulomb_friction|size 2|noise 1|multisine|0"
    assert CASE.seed() == 2141222896
    assert replace(CASE, number=1).seed() != CASE.seed() != CASE.seed("held out")
    assert Case(("a", "b"), 0.5, 3.0, "hold", 2).key == "a+b|size 0.5|noise 3|hold|2"
    assert CASE.reference.key == "nothing|size 0|noise 1|multisine|0"


def test_grid_has_every_combination_the_clean_records_and_pairs() -> None:
    grid = Grid(
        effects=("static_torque", "backlash", "test_cubic_drag"),
        sizes=(1.0, 4.0),
        noises=(1.0, 3.0),
        excitations=("multisine", "hold"),
        seeds=3,
    )
    cases = grid.cases()
    assert len({case.key for case in cases}) == len(cases)
    count = {kind: sum(case.kind is kind for case in cases) for kind in Kind}
    assert count == {Kind.NOTHING: 12, Kind.ONE: 48, Kind.UNLISTED: 24, Kind.TWO: 24}
    assert cases[0].kind is Kind.NOTHING
    assert {case.reference for case in cases} == {case for case in cases if not case.effects and case.number == 0}
    assert grid.cases() == cases


def test_grids_with_other_record_numbers_share_only_the_references() -> None:
    one, other = (Grid(effects=("static_torque",), excitations=("hold",), seeds=2, first=first) for first in (0, 2))
    assert {case.number for case in other.cases()} == {2, 3}
    assert not set(one.cases()) & set(other.cases())
    assert {case.reference for case in one.cases()} == {case.reference for case in other.cases()}


def test_default_grid_hides_every_effect_and_the_quick_one_has_every_kind() -> None:
    cases = Grid().cases()
    assert {effect for case in cases for effect in case.effects} == {*HIDDEN, *UNLISTED}
    assert {case.kind for case in QUICK.cases()} == set(Kind)


def test_confusable_effects_are_not_hidden_together() -> None:
    for number in range(5):
        for case in Grid(seeds=5, sizes=(2.0,), excitations=("hold",)).cases():
            if case.kind is Kind.TWO and case.number == number:
                one, other = (CATALOGUE[name] for name in case.effects)
                assert one.family is not other.family
                assert other.name not in one.confused_with


def test_effect_that_cannot_be_hidden_is_refused() -> None:
    with pytest.raises(UnknownEffectError, match="test_cubic_drag") as caught:
        Grid(effects=("gravity_nonlinearity",))
    assert caught.value.name == "gravity_nonlinearity"


def test_level_is_a_multiple_of_the_minimum_detectable_effect() -> None:
    """60 N m of dry friction are level 1. The minimum detectable effect is 15 N m; twice that is level 0.5."""
    assert levels(CASE, {"coulomb_friction": 15.0}) == {"coulomb_friction": 0.5}
    assert plant_sizes({"coulomb_friction": 0.5, "input_gain": 1.0}) == {"coulomb_friction": 30.0, "input_gain": -0.08}
    found = {
        levels(Case(("static_torque",), 3.0, 1.0, "hold", number), {"static_torque": 40.0})["static_torque"]
        for number in range(20)
    }
    assert found == {1.0, -1.0}
    for undetectable in ({}, {"coulomb_friction": float("inf")}, {"coulomb_friction": float("nan")}):
        with pytest.raises(NotDetectableError, match="coulomb_friction is not detectable with multisine"):
            levels(CASE, undetectable)


# --- the effects outside the catalogue


def test_unlisted_effects_are_in_no_catalogue() -> None:
    assert set(UNLISTED_EFFECTS) == set(UNLISTED)
    assert not set(UNLISTED) & {*CATALOGUE, *HIDDEN}
    assert all(name.startswith("test_") for name in UNLISTED)


@pytest.mark.parametrize("name", UNLISTED)
def test_plant_and_model_have_the_same_torque(name: str) -> None:
    """With the model's time origin at that of the plant's oscillation, so that one amplitude is enough."""
    from upright.service.hidden_effects.methods.terms import evaluated

    effect = UNLISTED_EFFECTS[name]
    validate(effect)
    assert get("monocab_reduced").add(effect).effects[0].parameters[0].unit == UNLISTED[name].unit
    source = np.random.default_rng(5)
    (torque,) = roll_effects(sizes_of({name: 1.0}, MONOCAB), inertia=1650.0, onsets={})
    for roll, rate, at in source.uniform(-0.05, 0.05, (20, 3)):
        plant = SimpleNamespace(roll=float(roll), roll_rate=float(rate), time=float(at))
        amplitudes = dict.fromkeys(effect.amplitudes, 0.0) | {"coefficient": UNLISTED[name].size}
        expected = evaluated(effect.force, {"coordinate": roll, "rate": rate, "time": at, **amplitudes})
        assert torque.torque(plant) == pytest.approx(float(expected), rel=1e-9, abs=1e-12)  # type: ignore[arg-type]


# --- running


def test_run_answers_every_case_and_a_second_run_repeats_none(folder: Path) -> None:
    path = folder / "results.jsonl"
    reported: list[tuple[int, int]] = []
    lines = benchmark(
        stand_in.SMALL.cases(), stand_in.bench(), path, processes(2), lambda done, total: reported.append((done, total))
    )
    assert list(lines) == [case.key for case in stand_in.SMALL.cases()]
    assert reported == [(done, 5) for done in range(6)]
    assert {line["status"] for line in lines.values()} == {"ok"}
    # The clean record is diagnosed once more, for the effects outside the catalogue.
    assert len(stand_in.traces()) == 6
    again = benchmark(stand_in.SMALL.cases(), stand_in.bench(), path, processes(2))
    assert again == lines
    assert len(stand_in.traces()) == 6
    assert results.read(path) == lines


def test_interrupted_run_is_resumed_where_it_was_cut_off(folder: Path) -> None:
    path = folder / "results.jsonl"
    cases = stand_in.SMALL.cases()
    whole = benchmark(cases, stand_in.bench(), path, processes(1))
    written = path.read_bytes().splitlines(keepends=True)
    path.write_bytes(b"".join(written[:3]) + written[3][:40])  # as after a crash in the middle of a write
    before = len(stand_in.traces())
    again = benchmark(cases, stand_in.bench(), path, processes(1))
    assert len(stand_in.traces()) == before + 2
    assert {key: _timeless(line) for key, line in again.items()} == {k: _timeless(line) for k, line in whole.items()}
    assert len(results.read(path)) == len(cases)


def test_added_method_runs_on_all_cases_and_other_conditions_are_refused(folder: Path) -> None:
    path = folder / "results.jsonl"
    cases = stand_in.SMALL.cases()
    benchmark(cases, stand_in.bench(), path, processes(1))
    lines = benchmark(cases, stand_in.bench(blind=stand_in.blind), path, processes(1))
    assert all(set(line["methods"]) == {SUBJECT, "blind"} for line in lines.values())
    with pytest.raises(results.ResultsError, match="another file") as caught:
        benchmark(cases, replace(stand_in.bench(), duration=20.0), path, processes(1))
    assert caught.value.path == path


def test_killed_worker_loses_no_case(folder: Path) -> None:
    cases = stand_in.SMALL.cases()
    lines = benchmark(cases, stand_in.bench(stand_in.killed_once), folder / "results.jsonl", processes(2))
    assert (folder / "traces" / "killed").exists()
    assert set(lines) == {case.key for case in cases}
    assert {line["status"] for line in lines.values()} == {"ok"}


def test_case_that_always_kills_its_worker_fails_alone_after_three_attempts(folder: Path) -> None:
    path = folder / "results.jsonl"
    lines = benchmark(stand_in.SMALL.cases(), stand_in.bench(stand_in.always_killed), path, processes(2))
    assert len(stand_in.traces("killed")) == 3
    failed = {key: line["reason"] for key, line in lines.items() if line["status"] != "ok"}
    assert failed == {CASE.key: "its worker process died 3 times"}
    # The failed case is run again, and no other.
    before = len(stand_in.traces())
    lines = benchmark(stand_in.SMALL.cases(), stand_in.bench(), path, processes(2))
    assert lines[CASE.key]["status"] == "ok"
    assert len(stand_in.traces()) == before + 1


def _refuses(*_: object, **__: object) -> Answer:
    raise ValueError("no idea")


def test_failed_method_is_reported_and_does_not_affect_the_others(folder: Path) -> None:
    line = run(CASE, stand_in.bench(refuses=_refuses), {"coulomb_friction": 60.0})
    assert line["status"] == "ok"
    assert line["methods"]["refuses"]["error"] == "ValueError: no idea"
    assert line["methods"][SUBJECT]["found"][0]["effect"] == "coulomb_friction"


def test_cases_fail_with_the_reason_of_their_failed_reference_case(folder: Path) -> None:
    bench = Bench(methods={SUBJECT: _refuses}, record=stand_in.labelled)
    lines = benchmark(stand_in.SMALL.cases(), bench, folder / "results.jsonl", processes(1))
    reasons = {line["reason"] for line in lines.values() if line["effects"]}
    assert reasons == {"the reference case failed: ValueError: no idea"}


def test_drawn_vehicles_deviate_as_their_file_says_and_are_reproducible() -> None:
    """The standard deviation of 400 vehicles is within 11 % of the true one, three standard errors. Normal numbers
    truncated at FARTHEST have 0.955 of the full standard deviation. A parameter that the record itself determines does
    not deviate."""
    known = load("monocab").parameters
    plants = [drawn(seed).plant for seed in range(400)]
    for name, unit, field in (
        ("angular_momentum", 1.0, "angular_momentum"),
        ("trim_height", 1.0, "trim_height"),
        ("speed_loop_lag", 0.25, "gimbal_time_constant"),
    ):
        off = np.array([getattr(plant, field) / unit - known.values[name] for plant in plants]) / known.deviations[name]
        assert np.std(off) == pytest.approx(0.955, rel=0.11), name
        assert abs(np.mean(off)) < 3.0 / np.sqrt(len(off)), name
        assert np.max(np.abs(off)) <= FARTHEST, name
    assert {plant.inertia for plant in plants} == {PlantTruth().inertia}
    latencies = [drawn(seed).latency for seed in range(400)]
    assert min(latencies) > 0.0
    assert np.mean(latencies) == pytest.approx(LATENCY, abs=3.0 * 0.002 / 20.0)
    assert drawn(3) == drawn(3)
    assert drawn(3) != drawn(4)


def test_both_records_of_a_case_are_from_the_same_vehicle() -> None:
    records: list[Recording] = []

    def keep(*case: Any) -> Recording:
        records.append(stand_in.labelled(*case))
        return records[-1]

    for case in (CASE, replace(CASE, number=1)):
        run(case, Bench(methods={}, record=keep), {"coulomb_friction": 1.0})
    latencies = [each.metadata["latency"] for each in records]
    assert latencies[0] == latencies[1]
    assert latencies[2] == latencies[3]
    assert latencies[0] != latencies[2]


def test_impossible_and_undetectable_cases_are_reported_by_their_status(folder: Path) -> None:
    line = run(Case(("flexible_mode",), 4.0, 1.0, "hold", 0), Bench(methods={}), {"flexible_mode": 0.5})
    assert line["status"] == "not_recorded"
    assert "flexible_mode cannot have the level" in line["reason"]
    assert run(CASE, Bench(methods={}), {})["status"] == "not_detectable"


INTERRUPTED = """
import signal
import sys
from pathlib import Path
import hidden_effects_stand_in as stand_in
from upright.service.hidden_effects.benchmark import benchmark
from upright.service.spread import processes
if __name__ == "__main__":
    # Under a shell that runs the tests in the background, Ctrl-C would be ignored.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        benchmark(stand_in.SMALL.cases(), stand_in.bench(stand_in.patient), Path(sys.argv[1]), processes(2))
    except KeyboardInterrupt:
        sys.exit(130)
"""


def test_ctrl_c_keeps_finished_cases_and_leaves_no_process(folder: Path) -> None:
    path, script = folder / "results.jsonl", folder / "interrupted.py"
    script.write_text(INTERRUPTED)
    running = subprocess.Popen(
        [sys.executable, script, path], env=environment(), start_new_session=True, cwd=TESTS.parents[1]
    )
    try:
        # The clean record is finished at once; then two cases, which take a minute, are running.
        until(lambda: path.exists() and len(stand_in.traces()) >= 4, 60.0)
        os.killpg(running.pid, signal.SIGINT)  # as a terminal does
        assert running.wait(20.0) == 130
    finally:
        if running.poll() is None:
            os.killpg(running.pid, signal.SIGKILL)
            running.wait()
    until(lambda: not _alive(running.pid), 10.0)
    assert list(results.read(path)) == [CASE.reference.key]


def _alive(group: int) -> bool:
    try:
        os.killpg(group, 0)
    except ProcessLookupError:
        return False
    return True


# --- on several machines


@pytest.fixture
def scheduler(folder: Path) -> Iterator[str]:
    """A Dask scheduler with two workers, each a process of its own."""
    pytest.importorskip("distributed", reason="Dask is not installed: pip install 'upright[fleet]'")
    with dask_scheduler.scheduler(folder) as address:
        yield address


@pytest.mark.filterwarnings("default")  # Dask's own, about its event loop
def test_dask_workers_give_the_same_answers_even_if_one_is_killed(folder: Path, scheduler: str) -> None:
    cases = stand_in.SMALL.cases()
    here = benchmark(cases, stand_in.bench(), folder / "here.jsonl", processes(1))
    there = benchmark(cases, stand_in.bench(stand_in.killed_once), folder / "there.jsonl", machines(scheduler))
    assert (folder / "traces" / "killed").exists()
    assert {key: _timeless(line) for key, line in there.items()} == {key: _timeless(line) for key, line in here.items()}


@pytest.mark.filterwarnings("default")
def test_unreachable_scheduler_is_reported_with_a_remedy(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("distributed", reason="Dask is not installed: pip install 'upright[fleet]'")
    monkeypatch.setattr("upright.service.spread.CONNECT_TIMEOUT", 0.5)
    spread: Spread = machines("tcp://127.0.0.1:1")
    with pytest.raises(SchedulerError, match="dask scheduler"):
        benchmark(stand_in.SMALL.cases(), stand_in.bench(), folder / "results.jsonl", spread)


def test_missing_dask_error_names_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(SchedulerError, match=r"upright\[fleet\]") as caught:
        machines("tcp://server:8786")
    assert caught.value.address == "tcp://server:8786"


# --- one complete record


@pytest.fixture(scope="module")
def dry() -> Recording:
    """Twice the default dry friction, 120 N m."""
    return virtual("multisine", {"coulomb_friction": 2.0}, 1.0, 12.0, 7, drawn(7))


NOMINAL = Bench(methods={}).nominal
SUPPORT = load("monocab").support
DRY = {"coulomb_friction", "stribeck_friction", "asymmetric_friction", "hysteresis", "load_dependent_friction"}


def test_regression_library_has_the_torques_of_the_catalogue(dry: Recording) -> None:
    from upright.estimators.data.segments import segments

    segment = segments(NOMINAL, [dry], support=SUPPORT)[0]
    names = measured(NOMINAL, segment)
    library = regression(NOMINAL, names)
    effects = {term.effect for term in library.terms}
    assert {"static_torque", "coulomb_friction", "quadratic_drag", "gimbal_angle_coupling"} <= effects
    assert not effects & {"hysteresis", "backlash", "flexible_mode", "input_delay", "gyro_bias"}
    rate = np.asarray(names["roll_rate"])
    (drag,) = [term for term in library.terms if term.effect == "quadratic_drag"]
    assert drag.columns[:, 0] == pytest.approx(-rate * np.abs(rate))
    pair = next(term for term in library.terms if term.effect == "periodic_disturbance")
    assert pair.columns.shape == (len(segment), 2)


def test_smoother_and_stepwise_regression_find_dry_friction(dry: Recording) -> None:
    """120 N m is eight times what is detectable in a 30 s record; no other family is confusable at this amplitude."""
    answer = BASELINES["smoother_stepwise"](NOMINAL, [dry], SUPPORT)
    assert answer.verdict == MISSING
    assert answer.found[0].effect in DRY


def test_sindy_names_only_effects_of_the_catalogue(dry: Recording) -> None:
    """The benchmark shows that it is wrong more often than not; tested is only that it names no foreign effect."""
    pytest.importorskip("pysindy", reason="PySINDy is not installed: pip install 'upright[bench]'")
    answer = BASELINES["differentiate_sindy"](NOMINAL, [dry], SUPPORT)
    assert answer.found
    assert {each.effect for each in answer.found} <= set(CATALOGUE)


def test_lowest_bic_of_output_error_fits_selects_dry_friction(dry: Recording) -> None:
    few = ("static_torque", "coulomb_friction", "cubic_stiffness")
    answer = BASELINES["exhaustive_bic"](NOMINAL, [dry], SUPPORT, few)
    assert [each.effect for each in answer.found] == ["coulomb_friction"]
    assert answer.revised is not None
    # The model's tanh is wider than the plant's bristles, so the amplitude is close, not equal.
    assert answer.revised.values["coulomb_friction.torque"] == pytest.approx(120.0, rel=0.25)


def test_right_model_leaves_less_error_than_the_nominal_one(dry: Recording) -> None:
    right, yardstick = fitted(right_model(NOMINAL, {"coulomb_friction": 2.0}, 6.8), [dry], SUPPORT)
    nominal, _ = fitted(NOMINAL, [dry], SUPPORT)
    floor = yardstick.energy(right, [dry], SUPPORT)
    # The innovations' covariance is their own mean square, plus a floor that limits the precision claimed for roll.
    assert 0.3 < floor < 1.1
    assert yardstick.energy(nominal, [dry], SUPPORT) > 1.01 * floor


# --- the command


def test_command_shows_the_figures_of_a_results_file(folder: Path) -> None:
    path, picture = folder / "results.jsonl", folder / "confusion.png"
    bench = stand_in.bench(blind=stand_in.blind)
    benchmark(stand_in.SMALL.cases(), bench, path, processes(1))
    shown = CliRunner().invoke(app, ["benchmark", "hidden-effects", "--summary", str(path), "--picture", str(picture)])
    assert shown.exit_code == 0, shown.output
    assert "100 % (34 to 100) 2" in shown.output
    assert picture.read_bytes()[:4] == b"\x89PNG"
    reported = CliRunner().invoke(app, ["benchmark", "hidden-effects", "--summary", str(path), "--json"])
    document = json.loads(reported.stdout)
    assert document["methods"][SUBJECT]["both"]["2"]["count"] == 1
    assert document["methods"]["blind"]["right_seen"] == {
        "value": 0.0,
        "low": 0.0,
        "high": pytest.approx(0.6576, abs=1e-4),
        "of": 2,
        "count": 0,
    }
    assert document["methods"][SUBJECT]["unlisted_unknown"]["count"] == 1


@pytest.mark.parametrize(
    ("arguments", "what"),
    [
        (["--sizes", "two"], "list of positive numbers"),
        (["--noise", "0"], "list of positive numbers"),
        (["--excitations", "multisin"], "is not one of hold"),
        (["--baseline", "sindy"], "is not one of differentiate_sindy"),
    ],
)
def test_invalid_option_is_a_usage_error_with_the_reason(arguments: list[str], what: str) -> None:
    shown = CliRunner().invoke(app, ["benchmark", "hidden-effects", *arguments], env={"COLUMNS": "200"})
    assert shown.exit_code == 2
    assert what in " ".join(shown.output.split())


def test_file_without_results_is_refused(tmp_path: Path) -> None:
    other = tmp_path / "x.jsonl"
    for text in ('{"a": 1}\n', "no json\n"):
        other.write_text(text)
        with pytest.raises(results.ResultsError, match="upright benchmark hidden-effects"):
            results.read(other)
    with pytest.raises(results.ResultsError, match="cannot be read"):
        results.read(tmp_path / "none.jsonl")


def test_confusion_picture_without_a_case_is_refused(tmp_path: Path) -> None:
    from upright.telemetry.errors import UprightError

    with pytest.raises(UprightError, match="no case"):
        save_confusion(summarise([]), tmp_path / "x.png")


def _timeless(line: dict[str, Any]) -> dict[str, Any]:
    methods = {name: {**reported, "seconds": 0.0} for name, reported in line["methods"].items()}
    return {**line, "methods": methods}
