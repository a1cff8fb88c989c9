"""The benchmark of hidden effects: what it asks, that nothing which is done is lost, and that its figures are right."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import hidden_effects_stand_in as stand_in
import numpy as np
import pytest
from typer.testing import CliRunner

from estimators.disturbance_estimate import DisturbanceEstimate
from models.effects.catalogue import CATALOGUE
from models.file.effect_rules import validate
from models.library import get
from service.cli import app
from service.hidden_effects.benchmark import benchmark
from service.hidden_effects.cases import QUICK, Case, Grid, Kind
from service.hidden_effects.methods.answers import MISSING, UNKNOWN, Answer, of_diagnosis
from service.hidden_effects.methods.baselines import BASELINES
from service.hidden_effects.methods.terms import measured, regression
from service.hidden_effects.results import trials as results
from service.hidden_effects.results.confusion_picture import save_confusion
from service.hidden_effects.results.summary import middle, share, summarise
from service.hidden_effects.revision import closed, fitted
from service.hidden_effects.sizes import NotDetectableError, levels, plant_sizes, right_model
from service.hidden_effects.spread import SchedulerError, Spread, machines, processes
from service.hidden_effects.trial import SUBJECT, Bench, run, virtual
from service.hidden_effects.unlisted import UNLISTED_EFFECTS
from service.hidden_effects.vehicles import FARTHEST, LATENCY, drawn
from simulation.monocab.hidden import HIDDEN, MONOCAB, UNLISTED
from simulation.monocab.roll_effects import roll_effects
from simulation.monocab.truth import PlantTruth
from simulation.registry import UnknownEffectError, sizes_of
from telemetry.recording import Recording
from vehicles.file import load

pytestmark = pytest.mark.timeout(300)
"""Worker processes import numpy and SciPy anew, many times over; on a busy machine that takes a minute a test."""

TESTS = Path(__file__).resolve().parents[1] / "support"
CASE = Case(("coulomb_friction",), 2.0, 1.0, "multisine", 0)


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Where the stand-ins leave their traces."""
    traces = tmp_path / "traces"
    traces.mkdir()
    monkeypatch.setenv(stand_in.FOLDER, str(traces))
    return tmp_path


# --- what is asked


def test_a_key_and_its_seed_never_change() -> None:
    """Results of another day and machine are matched by them."""
    assert CASE.key == "coulomb_friction|size 2|noise 1|multisine|0"
    assert CASE.seed() == 2141222896
    assert replace(CASE, number=1).seed() != CASE.seed() != CASE.seed("held out")
    assert Case(("a", "b"), 0.5, 3.0, "hold", 2).key == "a+b|size 0.5|noise 3|hold|2"
    assert CASE.reference.key == "nothing|size 0|noise 1|multisine|0"


def test_a_grid_is_every_combination_and_the_clean_records_and_pairs() -> None:
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


def test_a_grid_of_further_records_shares_no_record_but_the_reference_with_the_first() -> None:
    one, other = (Grid(effects=("static_torque",), excitations=("hold",), seeds=2, first=first) for first in (0, 2))
    assert {case.number for case in other.cases()} == {2, 3}
    assert not set(one.cases()) & set(other.cases())
    assert {case.reference for case in one.cases()} == {case.reference for case in other.cases()}


def test_the_whole_grid_hides_everything_there_is() -> None:
    cases = Grid().cases()
    assert {effect for case in cases for effect in case.effects} == {*HIDDEN, *UNLISTED}
    assert {case.kind for case in QUICK.cases()} == set(Kind)


def test_two_effects_that_look_alike_are_not_hidden_together() -> None:
    for number in range(5):
        for case in Grid(seeds=5, sizes=(2.0,), excitations=("hold",)).cases():
            if case.kind is Kind.TWO and case.number == number:
                one, other = (CATALOGUE[name] for name in case.effects)
                assert one.family is not other.family
                assert other.name not in one.confused_with


def test_an_effect_that_cannot_be_hidden_is_refused() -> None:
    with pytest.raises(UnknownEffectError, match="test_cubic_drag") as caught:
        Grid(effects=("gravity_nonlinearity",))
    assert caught.value.name == "gravity_nonlinearity"


def test_a_level_is_the_multiple_of_what_can_be_seen() -> None:
    """60 N m of dry friction are level 1; 15 N m can be seen; two of these are level 0.5."""
    assert levels(CASE, {"coulomb_friction": 15.0}) == {"coulomb_friction": 0.5}
    assert plant_sizes({"coulomb_friction": 0.5, "input_gain": 1.0}) == {"coulomb_friction": 30.0, "input_gain": -0.08}
    found = {
        levels(Case(("static_torque",), 3.0, 1.0, "hold", number), {"static_torque": 40.0})["static_torque"]
        for number in range(20)
    }
    assert found == {1.0, -1.0}
    for unseen in ({}, {"coulomb_friction": float("inf")}, {"coulomb_friction": float("nan")}):
        with pytest.raises(NotDetectableError, match="coulomb_friction is not detectable with multisine"):
            levels(CASE, unseen)


# --- the effects that no catalogue has


def test_no_catalogue_has_them() -> None:
    assert set(UNLISTED_EFFECTS) == set(UNLISTED)
    assert not set(UNLISTED) & {*CATALOGUE, *HIDDEN}
    assert all(name.startswith("test_") for name in UNLISTED)


@pytest.mark.parametrize("name", UNLISTED)
def test_plant_and_model_have_the_same_torque(name: str) -> None:
    """At a time where the swing's phase is that of the plant, so that one amplitude is enough."""
    from service.hidden_effects.methods.terms import evaluated

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


def test_a_run_answers_every_case_and_a_second_one_asks_nothing(folder: Path) -> None:
    path = folder / "results.jsonl"
    told: list[tuple[int, int]] = []
    lines = benchmark(
        stand_in.SMALL.cases(), stand_in.bench(), path, processes(2), lambda done, total: told.append((done, total))
    )
    assert list(lines) == [case.key for case in stand_in.SMALL.cases()]
    assert told == [(done, 5) for done in range(6)]
    assert {line["status"] for line in lines.values()} == {"ok"}
    # The clean record is asked once more, for what no catalogue has.
    assert len(stand_in.traces()) == 6
    again = benchmark(stand_in.SMALL.cases(), stand_in.bench(), path, processes(2))
    assert again == lines
    assert len(stand_in.traces()) == 6
    assert results.read(path) == lines


def test_a_run_goes_on_where_it_was_cut_off(folder: Path) -> None:
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


def test_a_further_method_asks_again_and_other_conditions_are_refused(folder: Path) -> None:
    path = folder / "results.jsonl"
    cases = stand_in.SMALL.cases()
    benchmark(cases, stand_in.bench(), path, processes(1))
    lines = benchmark(cases, stand_in.bench(blind=stand_in.blind), path, processes(1))
    assert all(set(line["methods"]) == {SUBJECT, "blind"} for line in lines.values())
    with pytest.raises(results.ResultsError, match="another file") as caught:
        benchmark(cases, replace(stand_in.bench(), duration=20.0), path, processes(1))
    assert caught.value.path == path


def test_a_killed_worker_loses_nothing(folder: Path) -> None:
    cases = stand_in.SMALL.cases()
    lines = benchmark(cases, stand_in.bench(stand_in.killed_once), folder / "results.jsonl", processes(2))
    assert (folder / "traces" / "killed").exists()
    assert set(lines) == {case.key for case in cases}
    assert {line["status"] for line in lines.values()} == {"ok"}


def test_a_case_that_kills_its_worker_every_time_fails_alone_after_three_tries(folder: Path) -> None:
    path = folder / "results.jsonl"
    lines = benchmark(stand_in.SMALL.cases(), stand_in.bench(stand_in.always_killed), path, processes(2))
    assert len(stand_in.traces("killed")) == 3
    failed = {key: line["reason"] for key, line in lines.items() if line["status"] != "ok"}
    assert failed == {CASE.key: "its worker process died 3 times"}
    # What failed is asked again, and nothing else is.
    before = len(stand_in.traces())
    lines = benchmark(stand_in.SMALL.cases(), stand_in.bench(), path, processes(2))
    assert lines[CASE.key]["status"] == "ok"
    assert len(stand_in.traces()) == before + 1


def _refuses(*_: object, **__: object) -> Answer:
    raise ValueError("no idea")


def test_a_method_that_fails_is_told_and_does_not_touch_the_others(folder: Path) -> None:
    line = run(CASE, stand_in.bench(refuses=_refuses), {"coulomb_friction": 60.0})
    assert line["status"] == "ok"
    assert line["methods"]["refuses"]["error"] == "ValueError: no idea"
    assert line["methods"][SUBJECT]["found"][0]["effect"] == "coulomb_friction"


def test_without_the_clean_record_nothing_can_be_asked(folder: Path) -> None:
    bench = Bench(methods={SUBJECT: _refuses}, record=stand_in.labelled)
    lines = benchmark(stand_in.SMALL.cases(), bench, folder / "results.jsonl", processes(1))
    reasons = {line["reason"] for line in lines.values() if line["effects"]}
    assert reasons == {"the reference case failed: ValueError: no idea"}


def test_vehicles_are_as_far_off_as_their_file_says_and_come_again() -> None:
    """Of 400 the standard deviation comes within 11 % of the true one, three of its own; cut off where they are, normal
    numbers have 0.955 of it. What the record itself tells stays."""
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


def test_both_records_of_a_case_are_of_one_vehicle() -> None:
    asked: list[Recording] = []

    def keep(*case: Any) -> Recording:
        asked.append(stand_in.labelled(*case))
        return asked[-1]

    for case in (CASE, replace(CASE, number=1)):
        run(case, Bench(methods={}, record=keep), {"coulomb_friction": 1.0})
    latencies = [each.metadata["latency"] for each in asked]
    assert latencies[0] == latencies[1]
    assert latencies[2] == latencies[3]
    assert latencies[0] != latencies[2]


def test_what_the_vehicle_cannot_bear_is_told(folder: Path) -> None:
    line = run(Case(("flexible_mode",), 4.0, 1.0, "hold", 0), Bench(methods={}), {"flexible_mode": 0.5})
    assert line["status"] == "not_recorded"
    assert "flexible_mode cannot have the level" in line["reason"]
    assert run(CASE, Bench(methods={}), {})["status"] == "not_detectable"


INTERRUPTED = """
import signal
import sys
from pathlib import Path
import hidden_effects_stand_in as stand_in
from service.hidden_effects.benchmark import benchmark
from service.hidden_effects.spread import processes
if __name__ == "__main__":
    # Under a shell that runs the tests in the background, Ctrl-C would be ignored.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        benchmark(stand_in.SMALL.cases(), stand_in.bench(stand_in.patient), Path(sys.argv[1]), processes(2))
    except KeyboardInterrupt:
        sys.exit(130)
"""


def test_ctrl_c_keeps_what_is_done_and_leaves_no_process(folder: Path) -> None:
    path, script = folder / "results.jsonl", folder / "interrupted.py"
    script.write_text(INTERRUPTED)
    running = subprocess.Popen(
        [sys.executable, script, path], env=_environment(), start_new_session=True, cwd=TESTS.parents[1]
    )
    try:
        # The clean record is done at once, and then two cases, which take a minute, are under way.
        _until(lambda: path.exists() and len(stand_in.traces()) >= 4, 60.0)
        os.killpg(running.pid, signal.SIGINT)  # as a terminal does
        assert running.wait(20.0) == 130
    finally:
        if running.poll() is None:
            os.killpg(running.pid, signal.SIGKILL)
            running.wait()
    _until(lambda: not _alive(running.pid), 10.0)
    assert list(results.read(path)) == [CASE.reference.key]


def _alive(group: int) -> bool:
    try:
        os.killpg(group, 0)
    except ProcessLookupError:
        return False
    return True


# --- over machines


@pytest.fixture
def scheduler(folder: Path) -> Iterator[str]:
    """A Dask scheduler with two workers, each a process of its own."""
    pytest.importorskip("distributed", reason="Dask is not installed: pip install 'upright[bench]'")
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    address = f"tcp://127.0.0.1:{port}"
    dask = [sys.executable, "-m", "dask"]
    common = ["--no-dashboard"]
    quiet: dict[str, Any] = {
        "env": _environment(),
        "cwd": folder,
        "stdout": subprocess.DEVNULL,
        "stderr": subprocess.DEVNULL,
    }
    started = [subprocess.Popen([*dask, "scheduler", "--host", "127.0.0.1", "--port", str(port), *common], **quiet)]
    worker = [*dask, "worker", address, "--nthreads", "1", "--nworkers", "1", *common]
    started += [subprocess.Popen(worker, **quiet) for _ in range(2)]
    try:
        _until(lambda: _workers(address) == 2, 60.0)
        yield address
    finally:
        for process in reversed(started):
            process.terminate()
        for process in started:
            process.wait(20.0)


def _workers(address: str) -> int:
    code = (
        "import sys; from distributed import Client\n"
        "with Client(sys.argv[1], timeout=5) as client: print(len(client.scheduler_info(n_workers=-1)['workers']))"
    )
    done = subprocess.run([sys.executable, "-c", code, address], capture_output=True, text=True, timeout=60)
    return int(done.stdout) if done.returncode == 0 else 0


@pytest.mark.filterwarnings("default")  # Dask's own, about its event loop
def test_over_machines_the_answers_are_the_same_and_a_killed_worker_loses_nothing(folder: Path, scheduler: str) -> None:
    cases = stand_in.SMALL.cases()
    here = benchmark(cases, stand_in.bench(), folder / "here.jsonl", processes(1))
    there = benchmark(cases, stand_in.bench(stand_in.killed_once), folder / "there.jsonl", machines(scheduler))
    assert (folder / "traces" / "killed").exists()
    assert {key: _timeless(line) for key, line in there.items()} == {key: _timeless(line) for key, line in here.items()}


@pytest.mark.filterwarnings("default")
def test_a_scheduler_that_is_not_there_is_told(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("distributed", reason="Dask is not installed: pip install 'upright[bench]'")
    monkeypatch.setattr("service.hidden_effects.spread.CONNECT_TIMEOUT", 0.5)
    spread: Spread = machines("tcp://127.0.0.1:1")
    with pytest.raises(SchedulerError, match="dask scheduler"):
        benchmark(stand_in.SMALL.cases(), stand_in.bench(), folder / "results.jsonl", spread)


def test_without_dask_the_remedy_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(SchedulerError, match=r"upright\[bench\]") as caught:
        machines("tcp://server:8786")
    assert caught.value.address == "tcp://server:8786"


# --- the figures


def _line(
    kind: Kind, effects: list[str], size: float, answer: dict[str, Any], excitation: str = "hold"
) -> dict[str, Any]:
    told = {"verdict": MISSING, "found": [], "covered": {}, "seconds": 1.0, "error": "", **answer}
    return {
        "key": f"{effects}{size}{excitation}{json.dumps(answer)}",
        "kind": kind.value,
        "effects": effects,
        "size": size,
        "noise": 1.0,
        "excitation": excitation,
        "status": "ok",
        "conditions": "x",
        "methods": {"m": told},
    }


def _named(*effects: str, tied: tuple[str, ...] = ()) -> dict[str, Any]:
    return {"found": [{"effect": effect, "tied_with": list(tied), "parameters": {}} for effect in effects]}


def test_figures_of_a_small_set_are_those_worked_out_by_hand() -> None:
    one, two, strange, nothing = Kind.ONE, Kind.TWO, Kind.UNLISTED, Kind.NOTHING
    lines = [
        # Right, tied with one, tied with two (wrong), another name, failed, right but too small to count as seen.
        _line(one, ["a"], 2.0, {**_named("a"), "held_out_closed": 0.9, "covered": {"a": True}}),
        _line(one, ["a"], 2.0, {**_named("b", tied=("a",)), "held_out_closed": 1.0, "energy_over_floor": 1.02}),
        _line(one, ["a"], 4.0, {**_named("a", tied=("b", "c")), "held_out_closed": None, "verdict": UNKNOWN}),
        _line(one, ["b"], 4.0, {**_named("c", "b"), "held_out_closed": 0.2, "covered": {"b": False}}, "sweep"),
        {**_line(one, ["b"], 4.0, {}, "sweep"), "methods": {"m": {"error": "E", "seconds": 3.0}}},
        _line(one, ["b"], 1.0, {**_named("b"), "held_out_closed": 0.0}),
        # Both in either order, one alone, and one name for two effects.
        _line(two, ["a", "b"], 2.0, _named("b", "a")),
        _line(two, ["a", "b"], 2.0, _named("a")),
        _line(two, ["a", "b"], 8.0, _named("c", tied=("a",)) | {"verdict": MISSING}),
        _line(strange, ["test_x"], 2.0, _named("b") | {"verdict": UNKNOWN}),
        _line(strange, ["test_x"], 2.0, _named("a")),
        _line(strange, ["test_x"], 4.0, {"verdict": "adequate"}),
        _line(nothing, [], 0.0, {"verdict": "adequate", "energy_over_floor": 1.0}),
        _line(nothing, [], 0.0, {"verdict": UNKNOWN, "energy_over_floor": 0.98}, "sweep"),
        _line(nothing, [], 0.0, {"verdict": "insufficient_data"}, "hold"),
        {"status": "not_recorded", "key": "x", "kind": "one", "methods": {}, "conditions": "x"},
    ]
    summary = summarise(lines)
    assert dict(summary.cases) == {"ok": 15, "not_recorded": 1}
    merit = summary.methods["m"]

    def counted(figure: Any) -> tuple[int | None, int]:
        return figure.count, figure.of

    assert counted(merit.right_seen) == (2, 5)
    assert {size: counted(each) for size, each in merit.right.items()} == {"2": (2, 2), "4": (0, 3), "1": (1, 1)}
    assert {name: counted(each) for name, each in merit.right_by_excitation.items()} == {
        "hold": (2, 3),
        "sweep": (0, 2),
    }
    assert counted(merit.seen_unknown) == (1, 5)
    assert counted(merit.false_alarms_all) == (1, 3)
    assert {name: counted(each) for name, each in merit.false_alarms.items()} == {"hold": (0, 2), "sweep": (1, 1)}
    assert counted(merit.false_names) == counted(merit.false_names_that_matter) == (1, 12)
    assert counted(merit.unlisted_unknown) == (1, 3)
    assert counted(merit.unlisted_misnamed) == (1, 3)
    assert counted(merit.both_seen) == (1, 3)
    assert (merit.held_out_closed.value, merit.held_out_closed.of) == (0.9, 3)
    assert (merit.energy_over_floor.value, merit.energy_over_floor.of) == (1.0, 3)
    assert counted(merit.covered) == (1, 2)
    assert (merit.seconds.value, merit.seconds.of) == (1.0, 15)
    assert merit.failed == 1
    assert {row: dict(columns) for row, columns in merit.confusion.items()} == {
        "a": {"a": 2, "b": 1},
        "b": {"c": 1, "failed": 1},
        "test_x": {"unknown": 1, "a": 1, "nothing": 1},
    }


def test_a_disturbance_beside_what_has_no_name_is_told_apart() -> None:
    held, missed = ({"disturbance_covered": {"rms": holds}} for holds in (True, False))
    lines = [
        _line(Kind.NOTHING, [], 0.0, held),
        _line(Kind.ONE, ["a"], 2.0, _named("b", tied=("a", "c")) | held),
        _line(Kind.TWO, ["a", "b"], 2.0, _named("b", "a") | missed),
        # One of two, one too many, and what no catalogue has.
        _line(Kind.TWO, ["a", "b"], 2.0, _named("a") | missed),
        _line(Kind.ONE, ["a"], 2.0, _named("a", "c") | missed),
        _line(Kind.UNLISTED, ["test_x"], 2.0, {"verdict": UNKNOWN} | missed),
    ]
    merit = summarise(lines).methods["m"]
    of_all, named = (each["rms"] for each in (merit.disturbance_covered, merit.disturbance_covered_named))
    assert (of_all.count, of_all.of) == (2, 6)
    assert (named.count, named.of) == (2, 3)


def test_a_false_name_that_is_said_to_be_negligible_is_told_apart() -> None:
    beside = _named("a", "b")
    beside["found"][1]["negligible"] = True
    lines = [_line(Kind.ONE, ["a"], 2.0, beside), _line(Kind.ONE, ["a"], 2.0, _named("a", "c"))]
    merit = summarise(lines).methods["m"]
    assert (merit.false_names.count, merit.false_names_that_matter.count) == (2, 1)


def test_intervals_are_those_of_the_tables() -> None:
    """Wilson's for 8 of 10 as in Newcombe, Statistics in Medicine 17 (1998); a median's as in Conover, table A3."""
    found = share([True] * 8 + [False] * 2)
    assert (found.value, found.low, found.high) == pytest.approx((0.8, 0.4902, 0.9433), abs=5e-5)
    assert share([]).value is None
    ten = middle([*map(float, range(1, 11)), None])
    assert (ten.value, ten.low, ten.high, ten.of) == (5.5, 2.0, 9.0, 10)
    few = middle([1.0, 2.0, 3.0])
    assert (few.value, few.low, few.of) == (2.0, None, 3)


def test_the_error_closed_is_that_between_nominal_and_right_model() -> None:
    assert closed(3.0, 1.5, 1.0) == 0.75
    assert closed(1.0, 1.0, 1.0) is None


def test_an_answer_is_taken_from_a_diagnosis() -> None:
    def parameter(value: float | None) -> SimpleNamespace:
        return SimpleNamespace(value=value, std=None if value is None else 2.0)

    finding = SimpleNamespace(
        effect="coulomb_friction",
        tied_with=("hysteresis",),
        parameters={"torque": parameter(61.0), "other": parameter(None)},
        negligible=True,
    )
    shaken = DisturbanceEstimate("roll", "N m", 8.0, 0.4, 0.3, 0.03)
    found = SimpleNamespace(
        verdict=MISSING, findings=(finding,), revised=None, minimum_detectable={"x": 1.0}, disturbance=(shaken,)
    )
    answer = of_diagnosis(found)
    assert answer.disturbance == {"rms": (8.0, 0.4), "correlation_time": (0.3, 0.03)}
    bounded = replace(shaken, shown=False, std_error=None, correlation_time=None, correlation_time_error=None)
    assert of_diagnosis(SimpleNamespace(**{**vars(found), "disturbance": (bounded,)})).disturbance == {}
    assert answer.found[0].names == {"coulomb_friction", "hysteresis"}
    assert answer.found[0].parameters == {"torque": (61.0, 2.0)}
    assert answer.found[0].negligible
    assert answer.detectable == {"x": 1.0}
    unknown = of_diagnosis(SimpleNamespace(**{**vars(found), "verdict": UNKNOWN, "minimum_detectable": None}))
    assert (unknown.verdict, unknown.found, unknown.detectable) == (UNKNOWN, answer.found, {})


# --- one real record


@pytest.fixture(scope="module")
def dry() -> Recording:
    """Twice the default dry friction, 120 N m."""
    return virtual("multisine", {"coulomb_friction": 2.0}, 1.0, 12.0, 7, drawn(7))


NOMINAL = Bench(methods={}).nominal
SUPPORT = load("monocab").support
DRY = {"coulomb_friction", "stribeck_friction", "asymmetric_friction", "hysteresis", "load_dependent_friction"}


def test_the_library_is_the_catalogue_s_own_torque(dry: Recording) -> None:
    from estimators.data.segments import segments

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


def test_smoothing_and_stepwise_find_dry_friction(dry: Recording) -> None:
    """120 N m is eight times what a 30 s record shows, and no other family looks like it at this size."""
    answer = BASELINES["smoother_stepwise"](NOMINAL, [dry], SUPPORT)
    assert answer.verdict == MISSING
    assert answer.found[0].effect in DRY


def test_sindy_answers(dry: Recording) -> None:
    """That it is wrong more often than not is what the benchmark shows; that it names nothing foreign is tested."""
    pytest.importorskip("pysindy", reason="PySINDy is not installed: pip install 'upright[bench]'")
    answer = BASELINES["differentiate_sindy"](NOMINAL, [dry], SUPPORT)
    assert answer.found
    assert {each.effect for each in answer.found} <= set(CATALOGUE)


def test_the_least_bic_of_output_error_is_dry_friction(dry: Recording) -> None:
    few = ("static_torque", "coulomb_friction", "cubic_stiffness")
    answer = BASELINES["exhaustive_bic"](NOMINAL, [dry], SUPPORT, few)
    assert [each.effect for each in answer.found] == ["coulomb_friction"]
    assert answer.revised is not None
    # The model's tanh is wider than the plant's bristles, so the size is near, not equal.
    assert answer.revised.values["coulomb_friction.torque"] == pytest.approx(120.0, rel=0.25)


def test_the_right_model_leaves_less_than_the_nominal_one(dry: Recording) -> None:
    right, yardstick = fitted(right_model(NOMINAL, {"coulomb_friction": 2.0}, 6.8), [dry], SUPPORT)
    nominal, _ = fitted(NOMINAL, [dry], SUPPORT)
    floor = yardstick.energy(right, [dry], SUPPORT)
    # The innovations' covariance is their own mean square, plus a floor on what the roll channel may claim.
    assert 0.3 < floor < 1.1
    assert yardstick.energy(nominal, [dry], SUPPORT) > 1.01 * floor


# --- the command


def test_the_command_shows_the_figures_of_a_file(folder: Path) -> None:
    path, picture = folder / "results.jsonl", folder / "confusion.png"
    bench = stand_in.bench(blind=stand_in.blind)
    benchmark(stand_in.SMALL.cases(), bench, path, processes(1))
    shown = CliRunner().invoke(app, ["benchmark", "hidden-effects", "--summary", str(path), "--picture", str(picture)])
    assert shown.exit_code == 0, shown.output
    assert "100 % (34 to 100) 2" in shown.output
    assert picture.read_bytes()[:4] == b"\x89PNG"
    told = CliRunner().invoke(app, ["benchmark", "hidden-effects", "--summary", str(path), "--json"])
    document = json.loads(told.stdout)
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
def test_an_option_that_cannot_be_is_refused(arguments: list[str], what: str) -> None:
    shown = CliRunner().invoke(app, ["benchmark", "hidden-effects", *arguments], env={"COLUMNS": "200"})
    assert shown.exit_code == 2
    assert what in " ".join(shown.output.split())


def test_a_file_of_something_else_is_refused(tmp_path: Path) -> None:
    other = tmp_path / "x.jsonl"
    for text in ('{"a": 1}\n', "no json\n"):
        other.write_text(text)
        with pytest.raises(results.ResultsError, match="upright benchmark hidden-effects"):
            results.read(other)
    with pytest.raises(results.ResultsError, match="cannot be read"):
        results.read(tmp_path / "none.jsonl")


def test_there_is_nothing_to_draw_without_a_case(tmp_path: Path) -> None:
    from telemetry.errors import UprightError

    with pytest.raises(UprightError, match="no case"):
        save_confusion(summarise([]), tmp_path / "x.png")


def _timeless(line: dict[str, Any]) -> dict[str, Any]:
    methods = {name: {**told, "seconds": 0.0} for name, told in line["methods"].items()}
    return {**line, "methods": methods}


def _environment() -> dict[str, str]:
    return {**os.environ, "PYTHONPATH": os.pathsep.join((str(TESTS), str(TESTS.parents[1])))}


def _until(true: Callable[[], bool], limit: float) -> None:
    end = time.monotonic() + limit
    while not true():
        assert time.monotonic() < end, f"not so after {limit:g} s"
        time.sleep(0.1)
