"""All methods compared: which recordings each of them takes, the document, failures, the table, and the picture."""

from __future__ import annotations

import json
import runpy
import subprocess
import sys
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console
from typer.testing import CliRunner

from upright import estimators
from upright.diagnosis.report.figures.methods import method_figure, save_methods
from upright.estimators.contract import EstimationError
from upright.estimators.identify.run import identify, plan, with_values
from upright.estimators.identify.table import METHODS, Domain, Experiment, Takes, experiment_of, unsuited
from upright.models.file.document import ModelFile
from upright.models.file.model_file import write
from upright.models.parts import ModelError
from upright.service.cli import app
from upright.service.pages.identify import print_methods
from upright.telemetry.channels import ChannelTable
from upright.telemetry.recording import Recording
from upright.telemetry.storage import save
from upright.vehicles.file import load
from upright.vehicles.monocab.identification.own import OWN
from upright.vehicles.registry import UnknownKindError, nominal_model

EXAMPLES = Path(__file__).parents[3] / "examples"
EXAMPLE = runpy.run_path(str(EXAMPLES / "compare_methods.py"))
VEHICLE = load("monocab")
KNOWN, SUPPORT = VEHICLE.parameters, VEHICLE.support
TRUTH = {**EXAMPLE["TRUTH"], "static_torque.torque": 120.0}
STEP, SWEEP = Experiment("step", "rest"), Experiment("sweep", "roll_reference")
COMPARED = [name for name in METHODS if name != "output_error_simplex"]
"""The simplex finds the same values as the trust region (tests/estimators/fit/test_fits.py) in ten times the time."""
QUICK = ("least_squares", "frequency_output_error", "recursive_least_squares")


@pytest.fixture(scope="module")
def recordings() -> list[Recording]:
    """Two steps from rest and a sweep, with a static torque and a noisy gyro."""
    return EXAMPLE["runs"](steps=2, sweeps=1, seconds=30.0)


@pytest.fixture(scope="module")
def document(recordings: list[Recording]) -> dict[str, Any]:
    return EXAMPLE["compare"](recordings, COMPARED)


@pytest.fixture(scope="module")
def files(recordings: list[Recording], tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    folder = tmp_path_factory.mktemp("recordings")
    paths = [folder / name for name in ("first_step.arrow", "second_step.arrow", "sweep.arrow")]
    for recording, path in zip(recordings, paths, strict=True):
        save(recording, path)
    return paths


def run(*arguments: Any, **settings: Any) -> dict[str, Any]:
    recordings, *methods = arguments
    usual = {"own": OWN, "model": with_values(nominal_model("monocab"), KNOWN.values, KNOWN.deviations)}
    return identify(recordings, KNOWN.values, SUPPORT, methods, deviations=KNOWN.deviations, **{**usual, **settings})


def values(entry: Mapping[str, Any]) -> dict[str, float]:
    return {name: parameter["value"] for name, parameter in entry["parameters"].items()}


def test_comparison_reproduces_the_findings_of_the_paper(document: dict[str, Any]) -> None:
    methods = document["methods"]
    for name in ("output_error", "prediction_error", "instrumental_variables"):
        assert methods[name]["status"] == "ok", methods[name]["reason"]
        for parameter, true in TRUTH.items():
            entry = methods[name]["parameters"][parameter]
            # All 9 are within 3.2 standard deviations with a probability of 98.8 %.
            assert abs(entry["value"] - true) < 3.2 * entry["std"], (name, parameter)
    # Bias by noise on the roll acceleration: 14 % measured with four sets of seeds, scatter 0.3 %.
    biased = methods["least_squares"]["parameters"]["inertia"]
    assert 0.10 < 1.0 - biased["value"] / TRUTH["inertia"] < 0.18
    assert TRUTH["inertia"] - biased["value"] > 5.0 * biased["std"]
    assert (
        methods["instrumental_variables"]["fit_percent"]["roll"] > methods["least_squares"]["fit_percent"]["roll"] + 5.0
    )


def test_frequency_methods_neglect_the_static_torque_and_predict_worse(document: dict[str, Any]) -> None:
    for name in ("frequency_output_error", "frequency_equation_error"):
        entry = document["methods"][name]
        assert "static_torque.torque" not in {p for p, value in values(entry).items() if value is not None}
        assert "neglected" in entry["parameters"]["static_torque.torque"]["reason"]
        if entry["fit_percent"]:
            assert entry["fit_percent"]["roll"] < document["methods"]["output_error"]["fit_percent"]["roll"] - 50.0


def test_document_is_valid_json_of_the_specified_form(document: dict[str, Any]) -> None:
    json.dumps(document, allow_nan=False)
    assert list(document["methods"]) == COMPARED
    assert document["best"] == "prediction_error"
    assert "sound" in document["best_reason"]
    assert document["fit_horizon"] == 0.5
    assert not document["cancelled"]
    assert document["before"]["inertia"] == {"value": 1450.0, "std": 200.0, "unit": "kg m^2"}
    for name, entry in document["methods"].items():
        keys = {"parameters", "fit_percent", "seconds", "status", "reason", "runs", "mean", "domain", "unsound"}
        assert keys <= entry.keys()
        assert (entry["not_chosen"] == "") == (name == "prediction_error")
        for parameter in entry["parameters"].values():
            assert {"value", "std", "unit", "identifiable"} <= parameter.keys()
            assert parameter["identifiable"] == (parameter["value"] is not None)
        assert len(entry["runs"]) == 3
        taken = [run["status"] != "not_suited" for run in entry["runs"]]
        assert taken == {
            Takes.ALL: [True, True, True], Takes.STEPS: [True, True, False], Takes.BANDS: [False, False, True]
        }[METHODS[name].takes]  # fmt: skip


def test_runs_and_their_mean_match_fits_of_single_recordings(
    recordings: list[Recording], document: dict[str, Any]
) -> None:
    entry = document["methods"]["least_squares"]
    first, second, third = entry["runs"]
    alone = run(recordings[:1], "least_squares", bandwidth=EXAMPLE["BANDWIDTH"])["methods"]["least_squares"]
    assert values(first) == values(alone) == values(alone["runs"][0])
    both = [values(each)["inertia"] for each in (first, second)]
    assert entry["mean"]["inertia"]["value"] == pytest.approx(np.mean(both))
    assert entry["mean"]["inertia"]["std"] == pytest.approx(np.std(both, ddof=1))
    assert entry["mean"]["inertia"]["runs"] == 2
    assert alone["mean"]["inertia"]["std"] is None
    assert values(third) == {}
    assert "sweep" in third["reason"]


def test_drive_lag_entry_states_the_lag_and_the_apparent_inertia(document: dict[str, Any]) -> None:
    drives = document["methods"]["drive_lag"]
    shown, inertia = drives["parameters"], document["methods"][drives["inertia_from"]]["parameters"]["inertia"]["value"]
    assert drives["domain"] == "drives"
    assert shown["speed_loop_lag"]["value"] == pytest.approx(0.04, rel=0.03)
    added = shown["apparent_inertia"]["value"] - inertia
    assert added == pytest.approx(3300.0 * shown["roll_reaction"]["value"])
    # 8 tau^2 L^2 / gimbal inertia of the plant, with its drag neglected
    assert shown["apparent_inertia_by_formula"]["value"] - inertia == pytest.approx(158.0, rel=0.05)


def test_option_every_gives_a_method_all_recordings(recordings: list[Recording]) -> None:
    entry = run(recordings, "least_squares", every=True)["methods"]["least_squares"]
    assert all(each["status"] == "ok" for each in entry["runs"])


@pytest.mark.parametrize(
    ("takes", "experiments", "taken"),
    [
        (Takes.STEPS, (STEP, SWEEP), (True, False)),
        (Takes.STEPS, (SWEEP, Experiment("none", "roll_reference")), (True, True)),
        (Takes.STEPS, (STEP, Experiment()), (True, True)),
        (Takes.BANDS, (STEP, SWEEP, Experiment("sweep", "controller_output")), (False, True, False)),
        (Takes.BANDS, (Experiment("none", "roll_reference"), Experiment("square", "roll_reference")), (False, False)),
        (Takes.BANDS, (Experiment("multisine", "roll_reference"), Experiment()), (True, True)),
        (Takes.ALL, (STEP, SWEEP, Experiment("none")), (True, True, True)),
    ],
)
def test_method_takes_the_recordings_that_suit_it(
    takes: Takes, experiments: tuple[Experiment, ...], taken: tuple[bool, ...]
) -> None:
    method = next(each for each in METHODS.values() if each.takes is takes)
    assert tuple(not reason for reason in unsuited(method, experiments)) == taken


@pytest.mark.parametrize("text", ["", "{", "[1]", "null", '{"excitation": null}'])
def test_recording_without_a_valid_definition_is_of_an_unknown_experiment(
    recordings: list[Recording], text: str
) -> None:
    unknown = replace(recordings[0], metadata={"experiment_definition": text})
    assert str(experiment_of(unknown)) == "an unknown experiment"
    assert str(experiment_of(recordings[0])) == "a step from rest"


def test_joint_fits_come_first_and_a_single_recording_is_fitted_once(recordings: list[Recording]) -> None:
    tasks = plan(recordings, {"least_squares": ["", "", "no"], "frequency_output_error": ["no", "no", ""]})
    assert [(task.method.name, task.recordings) for task in tasks] == [
        ("least_squares", (0, 1)), ("frequency_output_error", (2,)), ("least_squares", (0,)), ("least_squares", (1,)),
    ]  # fmt: skip


def test_method_without_a_suitable_recording_states_so_and_gives_no_values(recordings: list[Recording]) -> None:
    entry = run(recordings[:2], "frequency_output_error")["methods"]["frequency_output_error"]
    assert entry["status"] == "not_suited"
    assert entry["parameters"] == entry["mean"] == {}
    assert "a step from rest" in entry["reason"]
    assert "sweep" in entry["reason"]


def test_method_that_fails_does_not_stop_the_others(
    recordings: list[Recording], monkeypatch: pytest.MonkeyPatch
) -> None:
    def overflow(*_: object, **__: object) -> None:
        raise OverflowError("it ran away")

    monkeypatch.setattr(estimators, "least_squares", overflow, raising=False)
    methods = run(recordings, *QUICK)["methods"]
    assert methods["least_squares"]["status"] == "failed"
    assert methods["least_squares"]["reason"] == "OverflowError: it ran away"
    assert [each["status"] for each in methods["least_squares"]["runs"]] == ["failed", "failed", "not_suited"]
    assert methods["recursive_least_squares"]["status"] == "ok"


def test_missing_channel_is_the_status_of_each_method_that_needs_it(recordings: list[Recording]) -> None:
    step = recordings[0]
    channels = ChannelTable(channel for channel in step.channels if channel.name != "precession_rate")
    without = replace(step, channels=channels, values={name: step.values[name] for name in channels.names})
    methods = run([without], *QUICK, "drive_lag", "recursive_prediction_error")["methods"]
    shown = {name: entry["status"] for name, entry in methods.items()}
    assert shown.pop("frequency_output_error") == "not_suited"
    assert set(shown.values()) == {"missing_channel"}
    assert all("precession_rate" in methods[name]["reason"] for name in shown)


def test_interrupted_run_keeps_the_finished_results(recordings: list[Recording]) -> None:
    def interrupt(method: str, label: str, done: int, total: int) -> None:
        if done == 2:
            raise KeyboardInterrupt

    document = run(recordings, *QUICK, progress=interrupt)
    assert document["cancelled"]
    done, _, cut = (document["methods"][name] for name in QUICK)
    assert done["status"] == "ok"
    assert done["fit_percent"]["roll"] > 50.0
    assert {each["status"] for each in done["runs"]} == {"cancelled", "not_suited"}
    assert cut["status"] == "cancelled"
    assert values(cut) == {}


def test_progress_counts_all_fits(recordings: list[Recording]) -> None:
    shown: list[tuple[str, str, int, int]] = []
    run(recordings[:2], "least_squares", progress=lambda *each: shown.append(each))
    sources = [recording.source for recording in recordings[:2]]
    assert shown == [("least_squares", label, done, 3) for done, label in enumerate(["2 recordings", *sources])]


def test_unknown_method_or_kind_error_lists_the_available_ones(recordings: list[Recording]) -> None:
    with pytest.raises(EstimationError, match="magic") as caught:
        run(recordings, "magic")
    assert all(name in caught.value.remedy for name in METHODS)
    with pytest.raises(UnknownKindError, match="hovercraft") as refused:
        nominal_model("hovercraft")
    assert "monocab" in refused.value.remedy


def test_other_models_are_given_only_to_methods_for_any_model(recordings: list[Recording]) -> None:
    model = with_values(nominal_model("monocab"), KNOWN.values, KNOWN.deviations).add("viscous_friction")

    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    methods = identify(recordings[:1], {}, SUPPORT, model=model, progress=interrupt)["methods"]
    assert not {METHODS[name].domain for name in methods} & {Domain.RECURSIVE, Domain.DRIVES}
    document = identify(recordings[:1], {}, SUPPORT, ["least_squares"], model=model)
    assert document["fit_measured_alike"]
    # 1.5 over the pole of 3 rad/s.
    assert 0.3 < document["fit_horizon"] < 0.7
    assert document["methods"]["least_squares"]["fit_percent"].keys() == {"roll", "roll_rate"}
    assert "viscous_friction.coefficient" in document["methods"]["least_squares"]["parameters"]
    assert document["before"]["inertia"]["value"] == 1450.0


def test_picture_has_one_panel_per_parameter_with_all_methods_but_drive_lag(
    document: dict[str, Any], tmp_path: Path
) -> None:
    figure = method_figure(document, truth=EXAMPLE["TRUTH"])
    panels = [axes for axes in figure.axes if axes.get_ylabel()]
    assert [axes.get_ylabel() for axes in panels] == ["inertia, kg m²", "gravity stiffness, kN m/rad"]
    labels = [label.get_text() for label in panels[-1].get_xticklabels()]
    assert labels[0] == "CAD"
    assert len(labels) == 1 + sum(entry["domain"] != Domain.DRIVES for entry in document["methods"].values())
    groups = [text.get_text() for text in panels[0].texts]
    assert [name for name in groups if name in ("time domain", "frequency domain", "recursive")] == groups[-3:]
    low, high = panels[0].get_ylim()
    assert low < 1250.0
    assert high > TRUTH["inertia"]
    starts = {".png": b"\x89PNG", ".svg": b"<?xml", ".pdf": b"%PDF"}
    for suffix, start in starts.items():
        save_methods(document, tmp_path / f"methods{suffix}", truth=EXAMPLE["TRUTH"])
        assert (tmp_path / f"methods{suffix}").read_bytes().startswith(start)


def test_outlier_does_not_widen_the_axis_and_is_labelled_with_its_value(recordings: list[Recording]) -> None:
    document = run(recordings[:2], "least_squares", "frequency_output_error")
    entry = document["methods"]["least_squares"]
    entry["mean"]["inertia"]["value"] = entry["runs"][0]["parameters"]["inertia"]["value"] = 9000.0
    figure = method_figure(document, truth={"inertia": 1650.0})
    low, high = figure.axes[0].get_ylim()
    assert (low, high) == (pytest.approx(1250.0, rel=0.1), pytest.approx(1650.0, rel=0.1))
    texts = [text.get_text() for text in figure.axes[0].texts]
    assert "9000" in texts
    assert "not suited" in texts


def test_picture_without_content_or_in_an_unknown_format_is_refused(
    recordings: list[Recording], tmp_path: Path
) -> None:
    drives = run(recordings[:1], "drive_lag")
    with pytest.raises(EstimationError, match="nothing to draw"):
        method_figure(drives)
    with pytest.raises(EstimationError, match=r"\.bmp") as caught:
        save_methods(drives, tmp_path / "methods.bmp")
    assert ".svg" in caught.value.remedy


def command(*words: str, code: int = 0) -> str:
    result = CliRunner().invoke(app, ["identify", *words])
    assert result.exit_code == code, result.output
    return result.stdout


@pytest.mark.parametrize("width", [80, 100])
def test_table_fits_the_terminal(document: dict[str, Any], width: int, capsys: pytest.CaptureFixture[str]) -> None:
    print_methods(document, {"inertia": 1650.0}, Console(width=width, highlight=False))
    lines = capsys.readouterr().out.splitlines()
    assert max(len(line.rstrip()) for line in lines) <= width
    rows = [line for line in lines if line.startswith("prediction_error ")]
    # The joint estimate and the mean of the runs, each in as many tables as needed.
    assert len(rows) == {100: 2, 80: 4}[width]
    assert "±" in rows[0]
    assert any(line.startswith("CAD") and "1450 ± 200" in line for line in lines)
    assert any(line.startswith("truth") and "+13.8" in line for line in lines)
    assert "Recommended method: prediction_error" in lines
    assert "no transfer function contains it" in " ".join(" ".join(lines).split())
    assert not any("drive_offset" in line for line in lines)


def test_command_writes_json_and_a_picture(files: list[Path], tmp_path: Path) -> None:
    target = tmp_path / "methods.svg"
    words = ("-m", "least_squares", "--bandwidth", "20", "--picture", str(target), "--json")
    document = json.loads(command(str(files[0]), *words))
    wide = document["methods"]["least_squares"]["parameters"]["inertia"]["value"]
    usual = json.loads(command(str(files[0]), "-m", "least_squares", "--json"))
    assert usual["methods"]["least_squares"]["parameters"]["inertia"]["value"] > 1.05 * wide
    assert target.exists()


def test_model_from_file_or_library_is_used_as_it_is(files: list[Path], tmp_path: Path) -> None:
    path = tmp_path / "mine.toml"
    model = with_values(nominal_model("monocab"), KNOWN.values, KNOWN.deviations)
    write(ModelFile(model.change(estimated=["inertia", "gravity_stiffness"])), path)
    words = (str(files[0]), "-m", "least_squares", "--json", "--model")
    held = json.loads(command(*words, str(path)))["methods"]["least_squares"]["parameters"]
    assert set(held) == {"inertia", "gravity_stiffness"}
    shipped = json.loads(command(*words, "monocab_roll"))["methods"]["least_squares"]["parameters"]
    assert "static_torque.torque" not in shipped
    with pytest.raises(ModelError, match="no_such_model"):
        CliRunner().invoke(app, ["identify", *words, "no_such_model"], catch_exceptions=False)


def test_no_usable_method_exits_with_1_and_an_invalid_option_with_2(files: list[Path]) -> None:
    output = command(str(files[0]), "-m", "frequency_output_error", code=1)
    assert "not suited" in output
    assert "NAME=VALUE" in CliRunner().invoke(app, ["identify", str(files[0]), "--truth", "inertia"]).stderr
    command(str(files[0]), "--truth", "inertia=heavy", code=2)


def test_notebook_example_runs(files: list[Path]) -> None:
    script = str(EXAMPLES / "identify_in_a_notebook.py")
    done = subprocess.run([sys.executable, script, str(files[0])], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "static_torque.torque" in done.stdout
    assert "half a second ahead" in done.stdout
