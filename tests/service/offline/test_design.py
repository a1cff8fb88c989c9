"""`upright design`: controllers for a result, checked where it may be, predicted, adopted by the daemon, and back."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from closed_loop import ClosedLoop
from typer.testing import CliRunner

from upright.diagnosis.prediction.closed_loop_error import Loop
from upright.models.control_design.lqi import ControlDesignError
from upright.models.control_design.robustness import Known
from upright.models.parts import ModelError
from upright.service.cli import app
from upright.service.control.adopted import FILE, Adopted, AdoptedError, History
from upright.service.control.clients.commands import Commands
from upright.service.offline.design import Designed, ResultError, designed, read_result
from upright.vehicles import registry
from upright.vehicles.experiment.phases import Phase
from upright.vehicles.file import load

VEHICLE = load("monocab")
FOUND = {"inertia": 1650.0, "gravity_stiffness": 14500.0, "speed_loop_lag": 0.041}
STD = {"inertia": 8.0, "gravity_stiffness": 180.0, "speed_loop_lag": 1e-4}


def document(std: Mapping[str, float] = STD, correlation: float = 0.9) -> dict[str, Any]:
    """What `identify --json` gives, as far as a design uses it."""
    entries = {name: {"value": value, "std": std[name], "unit": ""} for name, value in FOUND.items()}
    lag = entries.pop("speed_loop_lag")
    of_roll = {**entries, "static_torque.torque": {"value": 3.0, "std": 1.0, "unit": "N m"}}
    of_roll["trim_height"] = {"value": None, "std": None, "unit": "m"}
    table = {"gravity_stiffness": {"inertia": correlation}}
    return {
        "best": "prediction_error",
        "methods": {
            "prediction_error": {"domain": "time", "parameters": of_roll, "correlation": table},
            "drive_lag": {"domain": "drives", "parameters": {"speed_loop_lag": lag}},
        },
    }


@pytest.fixture
def result(tmp_path: Path) -> Path:
    path = tmp_path / "result.json"
    path.write_text(json.dumps(document()))
    return path


@pytest.fixture(scope="module")
def found(tmp_path_factory: pytest.TempPathFactory) -> Designed:
    path = tmp_path_factory.mktemp("design") / "result.json"
    path.write_text(json.dumps(document()))
    return designed(VEHICLE, read_result(path, VEHICLE))


def commands(closed: ClosedLoop, data: Path) -> Commands:
    return Commands(VEHICLE, closed.loop, closed.witness, dict, data)  # type: ignore[arg-type]


async def ask(subject: Commands, **request: Any) -> dict[str, Any]:
    return [message async for message in subject.answer({"verb": "design", "client": "test", **request})][-1]


class TestResult:
    def test_estimates_of_all_methods_that_belong_together(self, result: Path) -> None:
        read = read_result(result, VEHICLE)
        assert read.values == FOUND
        assert read.deviations == STD
        assert read.correlation == {("gravity_stiffness", "inertia"): 0.9}
        assert read.model.values["static_torque.torque"] == 3.0
        assert read.model.values["inertia"] == 1650.0

    def test_model_file_has_no_correlation(self, tmp_path: Path) -> None:
        path = tmp_path / "mine.toml"
        path.write_text('base = "monocab_roll"\n[parameters]\ninertia = { value = 1600.0, std = 20.0 }\n')
        read = read_result(path, VEHICLE)
        assert (read.values["inertia"], read.deviations["inertia"]) == (1600.0, 20.0)
        assert not read.correlation

    @pytest.mark.parametrize(
        ("content", "message"),
        [
            ("[]", "recommends no method"),
            ("not JSON", "recommends no method"),
            ('{"best": "a", "methods": {"a": {"parameters": {}}}}', "estimates no parameter of the vehicle"),
            ("[" * 100_000, "recommends no method"),
            ('{"best": "a", "methods": {"a": {"parameters": {"inertia": {"value": [], "std": 1}}}}}', "no method"),
            ('{"best": "a", "methods": {"a": {"parameters": {"inertia": {"value": 1600}}}}}', "estimates no parameter"),
            (
                '{"best": "a", "methods": {"a": {"parameters": {"inertia": {"value": -1, "std": 1}}}}}',
                "inertia must be positive",
            ),
            ('{"best": "a", "methods": {"a": {"parameters": {"inertia": {"value": 1, "std": -1}}}}}', "inertia.std"),
        ],
    )
    def test_other_files_are_refused(self, tmp_path: Path, content: str, message: str) -> None:
        path = tmp_path / "other.json"
        path.write_text(content)
        with pytest.raises(ResultError, match=message):
            read_result(path, VEHICLE)
        with pytest.raises(ResultError, match="No such file"):
            read_result(tmp_path / "nothing.json", VEHICLE)

    def test_unknown_method_is_refused(self, result: Path) -> None:
        with pytest.raises(ResultError, match="has no result of simplex"):
            read_result(result, VEHICLE, "simplex")


class TestDesign:
    def test_both_controllers_are_designed_for_the_result(self, found: Designed) -> None:
        assert list(found.designs) == ["reduced", "full"]
        for name, each in found.designs.items():
            assert "the estimates' 95 % region and 1000 draws" in each.within
            assert each.worst.damping > 0.3
            cad = registry.of("monocab").designs(VEHICLE, nearly_certain(VEHICLE.parameters.values))[name]
            assert not np.allclose(each.gains.matrix, cad.gains.matrix, rtol=0.02)

    def test_experiments_are_predicted_with_it(self, found: Designed) -> None:
        expected = {each.name: each for each in found.expected}
        assert expected.keys() == VEHICLE.experiments.keys()
        assert "on its support" in expected["step"].broken
        load = {channel: value for channel, value, _, _ in expected["side_load"].largest}
        assert load["roll"] == pytest.approx(0.048, abs=0.005)
        assert load["precession"] == pytest.approx(11.8, abs=0.5)
        assert load["trim_position"] == pytest.approx(0.161, abs=0.005)
        assert all(value < limit for each in found.expected for _, value, limit, _ in each.largest)

    def test_correlation_decides_where_the_parameters_may_be(self) -> None:
        names = ("inertia", "gravity_stiffness")
        values = {name: FOUND[name] for name in names}
        apart = Known(values, STD, {}).about(names)
        together = Known(values, STD, {("gravity_stiffness", "inertia"): 0.9}).about(names)
        np.testing.assert_allclose(np.diag(together.covariance), np.diag(apart.covariance))
        assert together.covariance[0, 1] == pytest.approx(0.9 * 8.0 * 180.0)
        assert apart.covariance[0, 1] == 0.0

    def test_uncertain_result_is_refused_with_the_corner(self, tmp_path: Path) -> None:
        path = tmp_path / "vague.json"
        path.write_text(json.dumps(document({"inertia": 200.0, "gravity_stiffness": 1800.0, "speed_loop_lag": 0.01})))
        with pytest.raises(
            ControlDesignError, match=r"unstable within the estimates' 95 % region .*speed_loop_lag x 1"
        ):
            designed(VEHICLE, read_result(path, VEHICLE))

    def test_model_of_another_machine_is_refused(self, tmp_path: Path) -> None:
        path = tmp_path / "other.toml"
        path.write_text('base = "pendulum"\n')
        with pytest.raises(ModelError):
            designed(VEHICLE, read_result(path, VEHICLE))

    def test_gains_of_the_robot_are_in_its_file(self, tmp_path: Path) -> None:
        robot = load("twsbr")
        name = next(iter(robot.parameters.values))
        path = tmp_path / "robot.json"
        entry = {"value": robot.parameters.values[name], "std": 1e-3, "unit": ""}
        path.write_text(json.dumps({"best": "a", "methods": {"a": {"parameters": {name: entry}}}}))
        with pytest.raises(ResultError, match="are in its vehicle file"):
            designed(robot, read_result(path, robot))


def nearly_certain(values: Mapping[str, float]) -> Known:
    return Known(values, {name: 1e-6 * value for name, value in values.items()}, {})


class TestAdoption:
    async def test_next_experiment_runs_with_it_and_its_recording_says_so(self, tmp_path: Path, result: Path) -> None:
        closed = ClosedLoop()
        subject = commands(closed, tmp_path)
        read = read_result(result, VEHICLE)
        answer = await ask(subject, **{key: each for key, each in read.request.items() if key != "verb"})
        assert answer["exit_code"] == 0
        assert answer["design"]["values"] == FOUND
        assert "result.json, adopted on" in answer["text"]
        assert [code for _, code, _ in closed.witness.events] == ["design"]
        closed.run("doublet")
        recording = closed.recording("doublet")
        assert json.loads(recording.metadata["parameters"])["inertia"] == 1650.0
        # With the vehicle file alone, whose CAD values are others, the controller is reproduced.
        assert isinstance(registry.recorded_loop(VEHICLE, recording), Loop)
        other = registry.of("monocab").recorded_loop(VEHICLE, recording)
        assert "does not give the recorded setpoints" in str(other)

    async def test_side_load_is_measured_as_it_was_predicted(
        self, tmp_path: Path, result: Path, found: Designed
    ) -> None:
        closed = ClosedLoop()
        read = read_result(result, VEHICLE)
        await ask(commands(closed, tmp_path), **{key: each for key, each in read.request.items() if key != "verb"})
        closed.run("side_load")
        recording = closed.recording("side_load")
        # From one second before the load on: the gimbals' way back from getting up is not predicted.
        since = recording.time[np.argmax(recording["phase"] == Phase.EXCITE)] + 4.0
        loaded = (recording.time > since) & (recording["phase"] == Phase.EXCITE)
        expected = next(each for each in found.expected if each.name == "side_load")
        sizes = {channel: (predicted, unit) for channel, predicted, _, unit in expected.largest}
        for channel in ("roll", "precession", "trim_position"):  # the peak of the roll rate is the gyro's noise
            predicted, unit = sizes[channel]
            measured = float(np.max(np.abs(recording[channel][loaded]))) * (np.degrees(1.0) if unit == "deg" else 1.0)
            assert measured == pytest.approx(predicted, rel=0.05), channel

    async def test_it_survives_a_restart_and_can_be_taken_back(self, tmp_path: Path) -> None:
        first = commands(ClosedLoop(), tmp_path)
        for inertia in (1500.0, 1600.0):
            assert (await ask(first, source=f"{inertia:g}.json", values={"inertia": inertia}))["exit_code"] == 0
        closed = ClosedLoop()
        second = commands(closed, tmp_path)
        assert closed.loop.vehicle.parameters.values["inertia"] == 1600.0
        answer = await ask(second, back=True)
        assert answer["design"]["source"] == "1500.json"
        assert closed.loop.vehicle.parameters.values["inertia"] == 1500.0
        assert [each.source for each in History.read(tmp_path).entries] == ["", "1500.json", "1600.json", "1500.json"]

    async def test_without_anything_before_there_is_no_way_back(self, tmp_path: Path) -> None:
        answer = await ask(commands(ClosedLoop(), tmp_path), back=True)
        assert answer["exit_code"] == 3
        assert not (tmp_path / FILE).exists()

    async def test_what_cannot_be_kept_does_not_act(self, tmp_path: Path) -> None:
        closed = ClosedLoop()
        subject = commands(closed, tmp_path)
        (tmp_path / FILE).mkdir()  # the file cannot be replaced
        with pytest.raises(AdoptedError, match="nothing has changed"):
            await ask(subject, values=FOUND)
        assert closed.loop.vehicle.parameters == VEHICLE.parameters
        assert subject.adopted.entries == History().entries

    async def test_running_experiment_is_not_disturbed(self, tmp_path: Path) -> None:
        closed = ClosedLoop()
        subject = commands(closed, tmp_path)
        closed.loop.start_experiment("hold")
        closed.advance(0.1)
        answer = await ask(subject, values=FOUND)
        assert (answer["exit_code"], answer["text"]) == (3, "experiment hold is running; `upright stop` ends it.")
        assert closed.loop.vehicle is VEHICLE or closed.loop.vehicle.parameters == VEHICLE.parameters
        assert not (tmp_path / FILE).exists()

    @pytest.mark.parametrize(
        ("values", "error"),
        [
            ({"inertia": -5.0}, AdoptedError),
            ({"mass": 5.0}, AdoptedError),
            ({"speed_loop_lag": 3.0}, ControlDesignError),
        ],
    )
    async def test_impossible_parameters_change_nothing(
        self, tmp_path: Path, values: dict[str, float], error: type[Exception]
    ) -> None:
        closed = ClosedLoop()
        with pytest.raises(error):
            await ask(commands(closed, tmp_path), values=values)
        assert closed.loop.vehicle.parameters == VEHICLE.parameters
        assert not (tmp_path / FILE).exists()

    async def test_request_that_is_none_is_a_usage_error(self, tmp_path: Path) -> None:
        answer = await ask(commands(ClosedLoop(), tmp_path), values="many")
        assert answer["exit_code"] == 2

    def test_damaged_file_is_an_error_with_its_remedy(self, tmp_path: Path) -> None:
        (tmp_path / FILE).write_text('[{"values": "many"}]')
        with pytest.raises(AdoptedError, match=r"controller\.json cannot be read") as caught:
            commands(ClosedLoop(), tmp_path)
        assert "Move it away" in caught.value.remedy

    def test_unknown_keys_are_not_lost_silently(self) -> None:
        with pytest.raises(ValueError, match="extra"):
            Adopted.model_validate({"mass": 3.0})


class TestCommand:
    def test_it_prints_parameters_margins_and_predictions(self, result: Path) -> None:
        done = CliRunner().invoke(app, ["design", str(result)])
        assert done.exit_code == 0, done.output
        for words in ("prediction_error", "1650", "full controller at trim_rate_setpoint", "side_load", "--use"):
            assert words in done.stdout

    def test_as_json(self, result: Path) -> None:
        done = CliRunner().invoke(app, ["design", str(result), "--json"])
        answer = json.loads(done.stdout)
        assert answer["values"] == FOUND
        assert answer["controllers"]["full"]["phase_margin"] > 0.6
        assert answer["in_use"] is None

    @pytest.mark.parametrize("options", [["--use"], ["x.json", "--back"], ["x.json", "--use", "--back"]])
    def test_contradicting_options_are_refused(self, options: list[str]) -> None:
        assert CliRunner().invoke(app, ["design", *options]).exit_code == 2
