"""The next experiment: when it is run, it gives what was predicted for it; one that is too strong is refused."""

from __future__ import annotations

import asyncio
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from upright.diagnosis.diagnose import Diagnosis, Finding, Verdict
from upright.diagnosis.fits.refit import full
from upright.diagnosis.next_experiment import ENOUGH, LONGEST, Choice, expected_log_odds, suggest
from upright.diagnosis.prediction.closed_loop import simulate
from upright.diagnosis.prepare.workspace import Workspace
from upright.diagnosis.rivals import NOTHING_MORE, Rival, fitted_rivals
from upright.estimators.budget import Budget, OutOfTime
from upright.estimators.fit.problem import problem
from upright.estimators.identify.run import with_values
from upright.models import library
from upright.models.model import Model
from upright.service.cli import app
from upright.service.control.clients.api import ExitCode, Message, result
from upright.service.control.clients.server import ApiServer
from upright.service.offline.next_experiment import experiments_of, separating, suggest_for
from upright.service.virtual.run import record
from upright.telemetry.errors import UprightError
from upright.telemetry.recording import Recording
from upright.telemetry.storage import save
from upright.vehicles.experiment.phases import Phase
from upright.vehicles.file import VehicleFile, load
from upright.vehicles.registry import nominal_model

VEHICLE = load("monocab")
PAIR = ("viscous_friction", "coulomb_friction")
SECONDS = 20.0


def vehicle_model(name: str = "") -> Model:
    model = library.get(name) if name else nominal_model("monocab")
    return with_values(model, VEHICLE.parameters.values, VEHICLE.parameters.deviations)


def with_friction(model: Model, torque: float = 60.0) -> Model:
    return model.add("coulomb_friction").change({"coulomb_friction.torque": torque})


def only(*names: str, **changes: Any) -> VehicleFile:
    """The vehicle with these experiments alone, each with `changes`."""
    kept = {name: VEHICLE.experiments[name].model_copy(update=changes) for name in names}
    return VEHICLE.model_copy(update={"experiments": kept})


def while_excited(recording: Recording) -> Recording:
    """`recording` as if its roll were known during the excitation alone: the rise distinguishes effects, too."""
    roll = np.where(recording["phase"] == Phase.EXCITE, recording["roll"], np.nan)
    return replace(recording, values={**recording.values, "roll": roll})


@pytest.mark.parametrize("name", ["monocab_roll", "monocab_reduced", "monocab_full"])
def test_simulated_loop_gives_the_record_that_the_model_itself_predicts(name: str) -> None:
    model = with_friction(vehicle_model(name))
    (doublet,), _ = experiments_of(only("doublet"))
    course = simulate(model, doublet)
    assert course.broken == ""
    assert np.ptp(course.rows.measured[:, 0]) > 1e-3
    task = problem(model, (), rows=[course.rows])
    states = np.zeros(len(task.kernel.states))
    run = task.kernel.run(course.rows, task.kernel.vector(), states, substeps=task.substeps)
    assert np.array_equal(run.predicted, course.rows.measured)


def test_simulated_loop_moves_like_the_virtual_vehicle() -> None:
    # The virtual vehicle's true values (simulation.config); its roll also contains the noise of the roll filter.
    model = vehicle_model().change({"inertia": 1650.0, "gravity_stiffness": 14500.0})
    (sweep,), _ = experiments_of(only("sweep", duration=SECONDS))
    measured = record("monocab", "sweep", seed=2, duration=SECONDS)
    excited = np.flatnonzero(measured["phase"] == Phase.EXCITE)[: round(SECONDS / VEHICLE.period)]
    predicted = simulate(model, sweep).rows.measured[: len(excited), 0]
    error = measured["roll"][excited] - predicted
    # The lean and the roll error that the rise has left decay in the first seconds; after that a tenth covers the speed
    # loop, which this model describes as a lag.
    assert np.std(error[1250:]) < 0.1 * np.std(predicted[1250:])


def test_experiment_that_is_too_strong_is_refused_with_its_limit() -> None:
    rivals = [Rival.assumed(NOTHING_MORE, vehicle_model()), Rival.assumed("x", with_friction(vehicle_model()))]
    strong, _ = experiments_of(only("square", amplitude_deg=3.6))
    (outlook,) = suggest(rivals, strong).outlooks
    assert "roll would reach" in outlook.refused or "precession_rate_setpoint would reach" in outlook.refused
    assert "more than 80 % of the" in outlook.refused
    turning, _ = experiments_of(only("sweep", amplitude_deg=1.5, duration=SECONDS))
    choice = suggest(rivals, turning)
    assert choice.best is None
    assert choice.outlooks[0].refused


def test_experiments_that_start_at_rest_or_lack_an_excitation_are_left_out() -> None:
    found, left_out = experiments_of(VEHICLE)
    assert set(left_out) == {"hold", "side_load", "step", "rest", "tilt", "drives", "silence"}
    assert {each.name for each in found} | set(left_out) == set(VEHICLE.experiments)


def test_log_odds_of_an_effect_against_none_grow_with_its_amplitude() -> None:
    (doublet,), _ = experiments_of(only("doublet"))
    alone = Rival.assumed(NOTHING_MORE, vehicle_model())
    nats = []
    for torque in (0.5, 1.0):
        rival = Rival.assumed("coulomb_friction", with_friction(vehicle_model(), torque))
        nats.append(expected_log_odds(rival, simulate(rival.model, doublet).rows, alone))
    # The log-odds of a small effect grow with the square of its amplitude, those of a larger one a little less, as it
    # passes for noise.
    assert 3.0 < nats[1] / nats[0] < 4.1
    # A model with the effect can imitate one without: nothing speaks against it but its additional parameter.
    rows = simulate(alone.model, doublet).rows
    assert expected_log_odds(alone, rows, rival) < 0.01 * nats[0]


@pytest.fixture(scope="module")
def rivals() -> list[Rival]:
    """Viscous and dry friction, fitted to a record of a vehicle with viscous friction."""
    first = record("monocab", "multisine", hide=["viscous_friction=0.5"], seed=3, duration=SECONDS)
    return fitted_rivals(vehicle_model(), [first], VEHICLE.support, PAIR)


@pytest.fixture(scope="module")
def choice(rivals: list[Rival]) -> Choice:
    names = ("sweep", "output_sweep", "square", "full_sweep")
    return suggest(rivals, experiments_of(only(*names, duration=SECONDS))[0])


def measured_log_odds(experiment: str, rivals: list[Rival]) -> float:
    """Log-odds, nats, of viscous against dry friction in a further record of that vehicle."""
    recording = while_excited(record("monocab", experiment, hide=["viscous_friction=0.5"], seed=5, duration=SECONDS))
    workspace = Workspace.of(vehicle_model(), [recording], VEHICLE.support, PAIR)
    viscous, dry = (full(rival.model, workspace).log_likelihood for rival in rivals)
    return viscous - dry


def test_suggested_experiment_separates_better_than_the_worst_safe_one(choice: Choice, rivals: list[Rival]) -> None:
    assert choice.best is not None
    pair = PAIR
    safe = [each for each in choice.outlooks if not each.refused]
    worst = min(safe, key=lambda each: each.rates[pair])
    chosen = max(safe, key=lambda each: each.rates[pair])
    assert chosen.experiment.name == choice.best.experiment.name
    better, worse = (measured_log_odds(each.experiment.name, rivals) for each in (chosen, worst))
    # Log-odds scatter by sqrt(2 E), here 21 of 219 nats and 14 of 93: both bounds are three times that.
    assert better > worse + 75.0
    assert better == pytest.approx(chosen.rates[pair] * SECONDS, rel=0.3)


def test_suggested_experiment_is_no_longer_than_the_vehicle_file_allows(choice: Choice) -> None:
    best = choice.best
    assert best is not None
    assert best.experiment.duration <= SECONDS
    assert best.rate * best.seconds >= ENOUGH
    document = best.to_json()
    assert document["separates"] == list(PAIR)
    assert document["text"] == f"{best.seconds:.0f} s of {document['experiment']} separates {PAIR[0]} from {PAIR[1]}"
    assert document["parameters"]["duration"] == best.experiment.duration


def test_barely_detectable_effects_need_several_runs() -> None:
    best = separating(only("square"), vehicle_model(), PAIR).best
    assert best is not None
    assert best.experiment.duration < best.seconds <= LONGEST
    assert f"({best.runs} runs of 30 s)" in best.text


def test_inseparable_rivals_do_not_prevent_the_separation_of_others() -> None:
    viscous = vehicle_model().add("viscous_friction").change({"viscous_friction.coefficient": 400.0})
    dry = Rival.assumed("dry", with_friction(vehicle_model(), 20.0))
    best = suggest(
        [dry, Rival.assumed("viscous", viscous), Rival.assumed("twin", viscous)], experiments_of(only("doublet"))[0]
    ).best
    assert best is not None
    assert best.together == (("viscous", "twin"),)
    assert best.text == "12 s of doublet separates dry from viscous and twin; nothing here separates viscous from twin"


def test_tied_effects_get_an_experiment_that_separates_them() -> None:
    vehicle = only("sweep", "output_sweep", duration=SECONDS)
    recording = record("monocab", "square", hide=["coulomb_friction=0.2"], seed=4, duration=SECONDS)
    model = vehicle_model()
    finding = Finding(
        effect="coulomb_friction",
        family="dry_friction",
        parameters={},
        probability=0.6,
        p_value=1e-9,
        tied_with=("viscous_friction",),
        explanation="",
        log_likelihood_gain=30.0,
        held_out=None,
        odds={"coulomb_friction": 1.0, "viscous_friction": 0.5},
    )
    tied = Diagnosis(Verdict.MISSING_EFFECT, "", (finding,), revised=with_friction(model, 12.0))
    found = suggest_for(vehicle, tied, model, [recording])
    assert found is not None
    assert set(found) == {"experiment", "parameters", "seconds", "separates", "expected_log_odds_per_second", "text"}
    assert found["separates"] == ["coulomb_friction", "viscous_friction"]
    alone = replace(tied, findings=(replace(finding, tied_with=()),))
    assert suggest_for(vehicle, alone, model, [recording]) is None
    assert suggest_for(vehicle, Diagnosis(Verdict.UNKNOWN, ""), model, [recording]) is None
    # If prediction is impossible, only the suggestion is lost, not the diagnosis.
    strange = replace(tied, revised=library.get("axis").add("coulomb_friction"))
    assert suggest_for(vehicle, strange, model, [recording]) is None
    with pytest.raises(OutOfTime):
        suggest_for(vehicle, tied, model, [recording], budget=Budget.of(0.0))


def test_insufficient_data_get_an_experiment_that_separates_kinds_of_friction() -> None:
    vehicle = only("square", "doublet")
    found = suggest_for(vehicle, Diagnosis(Verdict.INSUFFICIENT_DATA, "too short"), vehicle_model(), [])
    assert found is not None
    assert found["experiment"] == "doublet"
    assert set(found["separates"]) == set(PAIR)


def test_adequate_model_gets_an_experiment_for_an_effect_that_it_may_lack() -> None:
    vehicle = only("sweep", duration=SECONDS)
    recording = record("monocab", "square", seed=4, duration=SECONDS)
    model = vehicle_model()
    seen = {"coulomb_friction": 1.0, "viscous_friction": 200.0}
    found = suggest_for(
        vehicle, Diagnosis(Verdict.ADEQUATE, "", minimum_detectable=seen, revised=model), model, [recording]
    )
    assert found is not None
    assert found["separates"] == ["viscous_friction", NOTHING_MORE]


def test_command_runs_the_experiment_that_separates(tmp_path: Path) -> None:
    requests: list[Mapping[str, Any]] = []

    async def answer(request: Message) -> Any:
        requests.append(request)
        yield result(ExitCode.REFUSED, "interlock", "The trim drive is off.")

    text = Path(VEHICLE.path).read_text(encoding="utf-8")
    head, *sections = text.split("[experiments.")
    kept = [part for part in sections if part.startswith(("hold]", "square]", "doublet]"))]
    file = tmp_path / "small.toml"
    file.write_text("[experiments.".join((head, *kept)), encoding="utf-8")

    async def run() -> tuple[int, str]:
        server = ApiServer(tmp_path / "x.sock", answer)
        await server.start()
        arguments = ["experiment", "--separate", *PAIR, "--vehicle", str(file), "--socket", str(tmp_path / "x.sock")]
        done = await asyncio.to_thread(CliRunner().invoke, app, arguments)
        await server.close()
        return done.exit_code, done.output

    code, output = asyncio.run(run())
    assert code == ExitCode.REFUSED
    assert [(each["verb"], each["name"]) for each in requests] == [("experiment", "doublet")]
    assert "of doublet" in output
    assert "separates" in output


def test_from_and_to_select_a_part_of_the_recordings(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "hold.arrow"
    whole = record("monocab", "hold", seed=6, duration=2.0)
    save(whole, path)
    seen: list[Recording] = []

    def separating(
        file: VehicleFile, model: Model, effects: object, recordings: list[Recording], progress: object
    ) -> Any:
        seen.extend(recordings)
        raise UprightError("enough was seen.", remedy="")

    monkeypatch.setattr("upright.service.offline.next_experiment.separating", separating)
    arguments = ["experiment", "--separate", *PAIR, str(path), "--from", "0.5", "--to", "1.5"]
    assert CliRunner().invoke(app, arguments).exit_code == 1
    (part,) = seen
    assert part.duration == pytest.approx(1.0, abs=0.02)
    assert part.timestamp_ns[0] - whole.timestamp_ns[0] == pytest.approx(0.5e9, abs=0.02e9)
    # A part without a recording, and a part outside of the recording, are refused.
    assert CliRunner().invoke(app, ["experiment", "sweep", "--from", "0.5"]).exit_code == ExitCode.USAGE
    nothing = CliRunner().invoke(app, [*arguments[:5], "--from", "500"])
    assert "has no rows from 500" in str(nothing.exception)
    assert len(seen) == 1


def test_command_without_a_name_or_with_two_is_a_usage_error() -> None:
    assert CliRunner().invoke(app, ["experiment"]).exit_code == ExitCode.USAGE
    assert CliRunner().invoke(app, ["experiment", "sweep", "square"]).exit_code == ExitCode.USAGE
