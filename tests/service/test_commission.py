"""`upright commission`: evaluations from recordings, the guide with a real daemon, its record, its report."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from closed_loop import ClosedLoop
from flywheels import with_flywheels
from typer.testing import CliRunner

from upright.service.cli import app
from upright.service.commission.evaluations import at_rest, course, drives
from upright.service.commission.evaluations.results import designed, with_best_drives
from upright.service.commission.evidence import Evidence, Found
from upright.service.commission.guide import Guide
from upright.service.control.clients.api import ApiError
from upright.service.control.commissioned import Record, RecordError
from upright.service.control.daemon import Places
from upright.service.virtual import daemon as virtual_daemon
from upright.service.virtual.daemon import daemon_beside
from upright.service.virtual.run import record
from upright.service.virtual.vehicle import before_commissioning
from upright.simulation.config import SimulationConfig
from upright.telemetry import storage
from upright.telemetry.candump import format_frames
from upright.vehicles import registry
from upright.vehicles.commissioning import CommissioningError, Entry, State, is_within, steps_of
from upright.vehicles.file import load
from upright.vehicles.monocab.identification.static_torque import static_torque
from upright.vehicles.monocab.identification.trim_effect import trim_effect
from upright.vehicles.sections import VehicleFile

VEHICLE = load("monocab")
STEPS = steps_of("monocab")


def unused(*arguments: Any) -> Any:
    raise AssertionError("not needed")


def evidence(
    folder: Path, step: str, experiment: str, *, read_as: VehicleFile = VEHICLE, kind: str = "monocab"
) -> Evidence:
    """A recording of the virtual vehicle with its raw log, as evidence for the daemon's file `read_as`."""
    closed = ClosedLoop(load(kind))
    closed.run(experiment)
    path = folder / f"{experiment}.arrow"
    storage.save(closed.recording(experiment), path)
    (_, start_ns), (_, end_ns) = closed.witness.recordings[-1], closed.witness.ended[-1]
    frames = [frame for frame in closed.raw if start_ns <= frame.timestamp_ns <= end_ns]
    path.with_suffix(".log").write_text(format_frames(frames, ["can0"]))
    return Evidence(read_as, steps_of(kind).find(step), [path], {}, folder, unused, unused)


def accepted(found: Found, step: str, kind: str = "monocab") -> bool:
    return all(is_within(each, found.numbers) for each in steps_of(kind).find(step).acceptance)


def with_imu(**keys: Any) -> VehicleFile:
    return VEHICLE.model_copy(update={"imu": VEHICLE.imu.model_copy(update=keys)})


class TestAtRest:
    @pytest.mark.parametrize("kind", registry.names())
    def test_the_imu_of_every_vehicle_is_as_its_file_says(self, tmp_path: Path, kind: str) -> None:
        given = evidence(tmp_path, "imu", "rest", read_as=load(kind), kind=kind)
        found = at_rest.imu_at_rest(given)
        assert accepted(found, "imu", kind)
        # gyro I of the data sheet, against what the filter assumes
        assumed = load(kind).imu.filter.angular_rate_density
        assert found.numbers["gyro_noise_percent"].value == pytest.approx(100.0 * 3.5e-5 / assumed, rel=0.05)
        assert found.numbers["gyro_bias"].value == pytest.approx(0.05, abs=0.005)

    @pytest.mark.parametrize("kind", registry.names())
    def test_a_tilt_shows_that_gravity_and_gyro_agree(self, tmp_path: Path, kind: str) -> None:
        found = at_rest.tilt(evidence(tmp_path, "tilt", "tilt", read_as=load(kind), kind=kind))
        assert found.numbers["gyro_scale"].value == pytest.approx(1.0, abs=0.01)
        assert accepted(found, "tilt", kind)

    @pytest.mark.parametrize(
        ("keys", "scale"),
        [
            ({"angular_rate_unit": "rad/s"}, 57.3),
            ({"axes": ("+x", "-y", "-z"), "acceleration_sign": -1}, 1.0),
            ({"axes": ("-x", "-y", "+z")}, 1.0),
        ],
        ids=["unit", "turned about x", "turned about z"],
    )
    def test_the_scale_is_what_the_remedy_says(self, tmp_path: Path, keys: dict[str, Any], scale: float) -> None:
        """A consistently turned IMU cannot be told from a turned vehicle: only a person sees which side it lies on."""
        found = at_rest.tilt(evidence(tmp_path, "tilt", "tilt", read_as=with_imu(**keys)))
        assert found.numbers["gyro_scale"].value == pytest.approx(scale, rel=0.02)

    def test_a_turned_imu_is_told_to_lie_on_the_other_side(self, tmp_path: Path) -> None:
        given = evidence(tmp_path, "imu", "rest")
        (right,) = at_rest.imu_at_rest(given).text
        (left,) = at_rest.imu_at_rest(replace(given, vehicle=with_imu(axes=("-x", "-y", "+z")))).text
        assert "right support" in right
        assert "left support" in left

    def test_a_vehicle_that_was_not_tilted_tells_nothing_of_the_gyro(self, tmp_path: Path) -> None:
        found = at_rest.tilt(evidence(tmp_path, "tilt", "rest"))
        assert found.numbers["gyro_scale"].value is None
        assert "not tilted" in found.text[-1]

    def test_a_log_without_the_imu_is_refused(self, tmp_path: Path) -> None:
        given = evidence(tmp_path, "imu", "silence")
        log = given.recording.with_suffix(".log")
        log.write_text("".join(line for line in log.read_text().splitlines(True) if "8A#" not in line))
        with pytest.raises(CommissioningError, match="0 samples of the IMU"):
            at_rest.imu_at_rest(given)


class TestDrives:
    def test_a_drive_that_does_not_watch_its_master_is_named(self, tmp_path: Path) -> None:
        """The set-up by SDO is left out here, so that no drive watches anything."""
        found = drives.silence(evidence(tmp_path, "silence", "silence"))
        assert found.numbers["drives_not_reacting"].value == 3.0
        assert "trim: no emergency message" in found.text
        assert not accepted(found, "silence")


class TestTrim:
    @pytest.mark.parametrize("hidden", ["", "coulomb_friction", "viscous_friction"])
    def test_the_weight_is_measured_within_its_deviation_whatever_rubs(self, hidden: str) -> None:
        hide = ["disturbance=8,0.3", *([hidden] if hidden else [])]
        trim, step = (record("monocab", name, hide=hide, seed=51) for name in ("trim", "step"))
        found = trim_effect(VEHICLE, [trim, step])["trim_effect"]
        assert found.value == pytest.approx(1.0, abs=2.5 * found.std)
        assert found.std < 0.03

    @pytest.mark.parametrize(
        ("changes", "effect"),
        [({"angular_momentum": 2970.0}, 1.0 / 0.9), ({"trim_mass": 1.0}, 0.0)],
        ids=["a flywheel is slow", "the mass sticks"],
    )
    def test_what_is_wrong_shows_in_the_weight(self, changes: dict[str, float], effect: float) -> None:
        def configure(config: SimulationConfig) -> SimulationConfig:
            return replace(config, plant=replace(config.plant, **changes))

        found = trim_effect(VEHICLE, [record("monocab", "trim", seed=52, configure=configure)])["trim_effect"]
        assert found.value == pytest.approx(effect, abs=2.5 * found.std + 0.01)

    def test_a_mass_that_runs_the_wrong_way_weighs_less_than_nothing(self) -> None:
        def configure(config: SimulationConfig) -> SimulationConfig:
            turned = [replace(each, direction=-1) if each.role == "trim" else each for each in config.drives]
            return replace(config, drives=turned)

        found = trim_effect(VEHICLE, [record("monocab", "trim", seed=53, configure=configure)])["trim_effect"]
        assert found.value == pytest.approx(-1.0, abs=2.5 * found.std)

    @pytest.mark.parametrize(("level", "true"), [(None, 0.0), (1.0, 120.0), (-2.0, -240.0)])
    def test_the_static_torque_is_measured_within_its_deviation(self, level: float | None, true: float) -> None:
        hide = ["disturbance=8,0.3", *([f"static_torque={level:g}"] if level else [])]
        found = static_torque(VEHICLE, [record("monocab", "hold", hide=hide, seed=41)])
        torque, shift = found["static_torque"], found["trim_shift"]
        assert torque.value == pytest.approx(true, abs=2.5 * torque.std)
        assert shift.value == pytest.approx(-1e3 * torque.value / (500.0 * 9.81))

    def test_friction_makes_the_static_torque_less_certain_and_not_unknown(self) -> None:
        hide = ["disturbance=8,0.3", "coulomb_friction"]
        torque = static_torque(VEHICLE, [record("monocab", "hold", hide=hide, seed=41)])["static_torque"]
        assert torque.value == pytest.approx(0.0, abs=2.5 * torque.std)
        assert 3.0 < torque.std < 60.0

    def test_the_course_has_each_channel_in_peoples_units(self, tmp_path: Path) -> None:
        found = course.course(evidence(tmp_path, "disturbance", "hold"))
        assert found.numbers["largest_roll"].unit == "deg"
        assert found.numbers["seconds"].value == pytest.approx(20.0, abs=0.1)


@contextmanager
def guided(
    folder: Path,
    *,
    told: VehicleFile = VEHICLE,
    truth: VehicleFile = VEHICLE,
    configure: Callable[[SimulationConfig], SimulationConfig] = lambda config: config,
) -> Iterator[Guide]:
    """A guide at a daemon with `told` as its file, for a virtual vehicle that is built like `truth`."""
    bus = f"virtual:{folder.name}"
    places = Places(bus, bus, folder, folder / "s.sock")
    with daemon_beside(told, places, [], 3, truth=truth, configure=configure):
        yield Guide(told, [places.socket], lambda messages: list(messages)[-1])


def until(there: Callable[[], bool], limit: float = 60.0) -> None:
    end = time.monotonic() + limit
    while not there():
        assert time.monotonic() < end
        time.sleep(0.1)


def interlocks(guide: Guide) -> str:
    """Those of the daemon, none before it answers."""
    try:
        return str(guide.ask({"verb": "status"})["status"]["interlocks"])
    except ApiError:
        return ""


class TestGuide:
    def test_steps_are_carried_out_kept_and_resumed_by_another_daemon(self, tmp_path: Path) -> None:
        with guided(tmp_path) as guide:
            guide.begin()
            for name in ("bus", "imu", "tilt", "silence"):
                entry = guide.carry_out(name)
                assert entry.state is State.ACCEPTED, entry
            recording = entry.recording
            assert set(entry.files) == {recording, recording.replace(".arrow", ".log")}
        with guided(tmp_path) as guide:
            following = guide.steps.next(guide.record())
            assert following is not None
            assert following.id == "drives"
            assert guide.carry_out("drives").state is State.ACCEPTED
            guide.skip("flywheels", "their tachometers were read in the morning")
            following = guide.steps.next(guide.record())
            assert following is not None
            assert following.id == "step"
            report = guide.save_report().read_text()
        assert "their tachometers were read in the morning" in report
        assert entry.files[recording] in report
        assert "signature" in report
        assert "not complete" in report

    def test_a_gyro_in_another_unit_is_found_before_a_drive_has_power(self, tmp_path: Path) -> None:
        with guided(tmp_path, truth=with_imu(angular_rate_unit="rad/s")) as guide:
            for name in ("bus", "imu"):
                assert guide.carry_out(name).state is State.ACCEPTED
            entry = guide.carry_out("tilt")
            assert entry.state is State.NOT_ACCEPTED
            assert entry.numbers["gyro_scale"].value == pytest.approx(0.01745, rel=0.02)
            with pytest.raises(CommissioningError, match="needs tilt first"):
                guide.carry_out("silence")
            assert all("silence" not in each.name for each in tmp_path.iterdir())

    def test_flywheels_are_watched_as_they_spin_up_and_run_down(self, tmp_path: Path) -> None:
        vehicle = with_flywheels(tmp_path)
        with guided(tmp_path, told=vehicle, truth=vehicle, configure=before_commissioning(vehicle)) as guide:
            for name in ("bus", "imu", "tilt", "silence", "drives"):
                guide.skip(name, "another test does it")
            with pytest.raises(CommissioningError, match="needs spin_up first"):
                guide.carry_out("step")
            up = guide.carry_out("spin_up")
            assert up.state is State.ACCEPTED, up
            assert up.numbers["angular_momentum"].value == pytest.approx(3300.0, abs=5.0)
            assert guide.carry_out("run_down").state is State.ACCEPTED
            entry = guide.carry_out("step")
        assert entry.state is State.FAILED
        assert "The flywheels turn too slowly" in entry.reason

    def test_a_refused_experiment_is_in_the_record_with_its_reason(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr(virtual_daemon, "READY_TIMEOUT", 0.0)  # it never gets ready
        with guided(tmp_path, truth=with_imu(axes=("+x", "-y", "-z"))) as guide:
            until(lambda: "does not rest on a support" in interlocks(guide))
            entry = guide.carry_out("bus")
            assert entry.state is State.NOT_ACCEPTED
            assert any("does not rest on a support" in line for line in entry.text)

    def test_skipping_needs_a_reason_and_a_step(self, tmp_path: Path) -> None:
        with guided(tmp_path) as guide:
            with pytest.raises(CommissioningError, match="without a reason"):
                guide.skip("bus", " ")
            with pytest.raises(CommissioningError, match="no step 'salto'"):
                guide.skip("salto", "because")


class TestModel:
    """A model with accepted effects belongs to its commissioning, and to the steps that name the one that wrote it."""

    def test_only_steps_that_name_it_use_it(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        guide = Guide(VEHICLE, [], unused)
        monkeypatch.setattr(Guide, "_folder", lambda self: tmp_path)
        model = tmp_path / "13_effects.toml"
        record = [Entry(), Entry(step="effects", state=State.ACCEPTED, model=str(model))]
        assert guide._evidence(STEPS.find("identify"), record, None).model == model
        assert guide._evidence(STEPS.find("step"), record, None).model is None
        assert guide._evidence(STEPS.find("identify"), [*record, Entry()], None).model is None

    def test_a_repeated_step_does_not_overwrite_what_the_record_names(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        guide = Guide(VEHICLE, [], unused)
        monkeypatch.setattr(Guide, "_folder", lambda self: tmp_path)
        step = STEPS.find("sweep")
        first, second = (guide._evidence(step, [Entry()] * count, None).at(".json") for count in (3, 4))
        assert (first.name, second.name) == ("03_sweep.json", "04_sweep.json")

    def test_a_new_commissioning_keeps_the_report_of_the_last(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        kept: list[Entry] = []
        monkeypatch.setattr(Guide, "_folder", lambda self: tmp_path)
        monkeypatch.setattr(Guide, "record", lambda self: [Entry()] * 19)
        monkeypatch.setattr(Guide, "_keep", lambda self, entry: kept.append(entry))
        (tmp_path / "report.html").write_text("signed")
        Guide(VEHICLE, [], unused).begin()
        assert (tmp_path / "19_report.html").read_text() == "signed"
        assert kept == [Entry()]


class TestRecord:
    def test_it_is_kept_in_the_data_folder(self, tmp_path: Path) -> None:
        record = Record.read(tmp_path, load("monocab")).with_next(Entry(step="bus", state=State.ACCEPTED))
        record.write(tmp_path)
        (found,) = Record.read(tmp_path, load("monocab")).entries
        assert (found.step, found.state) == ("bus", State.ACCEPTED)
        assert found.date

    def test_a_broken_file_is_refused_with_the_remedy(self, tmp_path: Path) -> None:
        (tmp_path / "commissioning.json").write_text("[{")
        with pytest.raises(RecordError, match=r"cannot be read.*Move it away"):
            Record.read(tmp_path, load("monocab"))

    def test_a_folder_that_cannot_be_written_loses_nothing_silently(self, tmp_path: Path) -> None:
        place = tmp_path / "file"
        place.write_text("")
        with pytest.raises(RecordError, match="not in the record"):
            Record.read(tmp_path, load("monocab")).with_next(Entry()).write(place)


class TestCommandLine:
    def run(self, *words: str) -> Any:
        return CliRunner().invoke(app, ["commission", *words])

    @pytest.mark.parametrize(
        ("words", "hint"),
        [
            (["--resume", "--begin"], "--resume, --begin"),
            (["--hide", "coulomb_friction"], "--virtual"),
            (["--recording", "x.arrow"], "--step"),
        ],
    )
    def test_contradictions_are_refused(self, words: list[str], hint: str) -> None:
        done = self.run(*words)
        assert done.exit_code == 2
        assert hint in done.output

    def test_events_are_json_lines_and_a_person_is_never_asked(self, tmp_path: Path) -> None:
        bus = f"virtual:{tmp_path.name}"
        places = Places(bus, bus, tmp_path, tmp_path / "s.sock")
        with daemon_beside(VEHICLE, places, [], 3):
            at = ["--socket", str(places.socket), "--json"]
            begun = [json.loads(line) for line in self.run("--begin", *at).stdout.splitlines()]
            assert [each["type"] for each in begun] == ["step", "result"]
            assert begun[0]["id"] == "bus"
            done = self.run("--step", "bus", "--yes", *at)
            outcome, result = (json.loads(line) for line in done.stdout.splitlines())
            assert (outcome["type"], outcome["state"], result["exit_code"]) == ("outcome", "accepted", 0)
            skipped = self.run("--skip", "imu", "--reason=calibrated yesterday", *at)
            assert skipped.exit_code == 0
            again = self.run(*at)
            assert isinstance(again.exception, CommissioningError)
            assert "--resume goes on" in str(again.exception)
            target = tmp_path / "so_far.html"
            assert self.run("--report", str(target), *at).exit_code == 0
            assert "calibrated yesterday" in target.read_text()


def of_drives(std: float | None) -> dict[str, Any]:
    return {"domain": "drives", "parameters": {"speed_loop_lag": {"value": 0.04, "std": std, "unit": "s"}}}


class TestDesigned:
    def test_margins_are_numbers(self, tmp_path: Path) -> None:
        result = tmp_path / "result.json"
        result.write_text(json.dumps({"best": "b", "methods": {"b": {"domain": "time", "parameters": {}}}}))
        margins = {"gain_margin": [0.12, 10.3], "phase_margin": 1.07, "delay_margin": 0.041}
        document = {"how": "as told", "controllers": {"reduced": margins, "full": margins}, "expected": []}
        stand_in: Any = SimpleNamespace(
            at=lambda suffix: tmp_path / f"step{suffix}",
            results={"sweep": result},
            model=None,
            upright=lambda words: document,
        )
        found = designed(stand_in)
        assert found.numbers["reduced_gain_margin"].value == pytest.approx(20.26, abs=0.01)
        assert found.numbers["full_delay_margin"].value == pytest.approx(41.0)
        assert found.text == ["as told"]


class TestBestDrives:
    def test_the_smallest_deviation_is_used_and_the_rest_is_the_newest(self) -> None:
        newest = {"best": "b", "methods": {"b": {"domain": "time", "parameters": {}}, "drive_lag": of_drives(2e-3)}}
        merged = with_best_drives([{"best": "", "methods": {"drive_lag": of_drives(1e-4)}}, newest])
        assert merged["best"] == "b"
        assert merged["methods"]["drive_lag"] == of_drives(1e-4)

    def test_an_unknown_lag_is_replaced_and_a_known_one_is_not(self) -> None:
        unknown, known = {"methods": {"drive_lag": of_drives(None)}}, {"methods": {"drive_lag": of_drives(1e-4)}}
        assert with_best_drives([known, unknown])["methods"]["drive_lag"] == of_drives(1e-4)
        assert with_best_drives([unknown, known])["methods"]["drive_lag"] == of_drives(1e-4)
