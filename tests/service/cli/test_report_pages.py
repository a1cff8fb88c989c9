"""The pages of a comparison and of an identification: each is one self-contained file with the contents of the JSON."""

from __future__ import annotations

import json
from functools import cache
from pathlib import Path
from typing import Any

import pytest
import small_vehicle
from typer.testing import CliRunner
from written_report import HASH, HOSTILE, Page

from upright.diagnosis.prediction.compare import Comparison, compare
from upright.diagnosis.report import Provenance, write_comparison, write_identification
from upright.diagnosis.report.figures.drawing import looks
from upright.estimators.disturbance_estimate import DisturbanceEstimate
from upright.estimators.identify.run import identify, with_values
from upright.models import library
from upright.service.cli import app
from upright.telemetry.recording import Recording
from upright.telemetry.storage import save
from upright.vehicles.file import load
from upright.vehicles.monocab.identification.own import OWN
from upright.vehicles.registry import nominal_model

VEHICLE = load("monocab")
TRUTH = library.get("monocab_roll").add("static_torque").change({"inertia": 1650.0, "gravity_stiffness": 14500.0})
RIGHT = TRUTH.change({"static_torque.torque": 40.0})
PROVENANCE = Provenance(vehicle="monocab", version="1.2.3", date="2031-02-03 04:05", hashes={HOSTILE: HASH})
METHODS = ("least_squares", "instrumental_variables", "drive_lag")
"""The fast methods."""


@cache
def sweep() -> Recording:
    table = small_vehicle.run(1, 21.0, reference=lambda t: small_vehicle.sweep(t, 20.0))
    return small_vehicle.recording(*table, 0)


@cache
def compared() -> list[Comparison]:
    models = {"CAD": TRUTH, "<b>right</b>": RIGHT}
    return compare(models, [sweep()], support=VEHICLE.support, loops=["the recording is <of> another vehicle"])


@cache
def document() -> dict[str, Any]:
    model = with_values(nominal_model("monocab"), VEHICLE.parameters.values, {})
    return identify([sweep()], VEHICLE.parameters.values, VEHICLE.support, METHODS, model=model, own=OWN)


def check(text: str) -> Page:
    """Check that the page is one document that loads nothing and escapes every given name, with unique ids."""
    page = Page(text)
    assert [len(page.all(tag)) for tag in ("html", "head", "body", "title", "h1", "footer")] == [1] * 6
    assert not {"script", "link", "img", "iframe", "object", "embed"} & {tag for tag, _ in page.tags}
    assert text.count("url(") == text.count("url(#") > 0
    assert "<b>" not in text
    ids = [attributes["id"] for _, attributes in page.tags if "id" in attributes]
    assert len(ids) == len(set(ids)) > 0
    for part in (HOSTILE, HASH, "monocab", "1.2.3", "2031-02-03 04:05"):
        assert part in page.text
    return page


@cache
def comparison_page() -> Page:
    answers = [(HOSTILE, compared()), ("runs/again.arrow", compared())]
    return check(write_comparison(answers, provenance=PROVENANCE))


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("pages") / "sweep.csv"
    save(sweep(), path)
    return path


class TestComparisonPage:
    def test_verdicts_come_first(self) -> None:
        before = comparison_page().text.split("Measured against predicted")[0]
        assert "<b>right</b>: adequate; CAD: not" in before
        assert before.count("again.arrow") == 3  # at the top, and once per model
        for each in compared():
            assert f"{each.innovation_ratio:.3g}" in before

    def test_each_recording_has_its_figures_and_numbers(self) -> None:
        figures = [each["aria-label"] for each in comparison_page().all("svg")]
        assert len(figures) == 2 * 3
        for each in compared():
            ratio = each.rmse["roll_rate"] / each.noise_floor["roll_rate"]
            assert comparison_page().text.count(f"{each.fit_percent['roll_rate']:.2f} %") == 2
            assert f"{ratio:.3g}" in comparison_page().text
        for sentence in compared()[0].summary:
            assert " ".join(sentence.split()) in comparison_page().text

    def test_unknown_control_loop_is_reported_with_its_reason(self) -> None:
        part = comparison_page().text.split("Simulated in the closed loop")[1].split("Where it fails")[0]
        assert "CAD, <b>right</b>: not available, the recording is <of> another vehicle." in part

    def test_six_models_have_distinct_colours_and_dashes(self) -> None:
        assert len({each.colour for each in looks(6)}) == len({str(each.dash) for each in looks(6)}) == 6
        assert len(looks(20)) == 20


class TestIdentificationPage:
    def test_recommended_method_is_shown_with_its_parameters(self) -> None:
        page = check(write_identification(document(), "monocab_roll", provenance=PROVENANCE, why="No <b>model</b>."))
        best = document()["best"]
        assert f"Recommended method: {best}" in page.text
        inertia = document()["methods"][best]["parameters"]["inertia"]["value"]
        head = page.text.split("The methods side by side")[0]
        assert f"inertia {inertia:.0f}" in head or f"inertia {inertia:.1f}" in head
        assert "Parameters by method, each run and their mean" in [each.get("aria-label") for each in page.all("svg")]
        for name in ("least_squares", "instrumental_variables", "speed_loop_lag"):
            assert name in page.text
        assert page.text.count("No <b>model</b>.") == 1

    def test_predictions_of_the_estimates_are_shown(self) -> None:
        text = write_identification(document(), "monocab_roll", comparisons=compared(), provenance=PROVENANCE)
        assert "Measured against predicted" in check(text).text


class TestCommands:
    def run(self, *arguments: Any, code: int = 0) -> str:
        done = CliRunner().invoke(app, [*map(str, arguments)])
        assert done.exit_code == code, done.output
        return done.stdout

    def test_compare_writes_its_report(self, file: Path, tmp_path: Path) -> None:
        report = tmp_path / "compare.html"
        answer = json.loads(self.run("compare", file, "--report", report, "--json"))
        assert [each["closed_loop"]["available"] for each in answer["models"]] == [False]
        assert answer["models"][0]["closed_loop"]["rmse"] == {}
        left = DisturbanceEstimate.from_json("roll", answer["models"][0]["disturbance"]["roll"])
        page = Page(report.read_text())
        assert "CAD: not adequate" in page.text
        assert str(left) in page.text
        assert f"disturbance, CAD: {left}" in " ".join(self.run("compare", file).split())
        assert "sweep.csv SHA-256" in page.text

    def test_identify_writes_its_report(self, file: Path, tmp_path: Path) -> None:
        report = tmp_path / "identify.html"
        assert f"Report: {report}" in self.run("identify", file, "-m", "least_squares", "--report", report).replace(
            "\n", ""
        )
        page = Page(report.read_text())
        assert "No method can be recommended" in page.text
        assert "run prediction_error" in page.text

    def test_identify_reports_the_disturbance(self, file: Path, tmp_path: Path) -> None:
        report = tmp_path / "shaken.html"
        words = ("identify", file, "-m", "prediction_error", "-m", "least_squares", "--report", report)
        methods = json.loads(self.run(*words, "--json"))["methods"]
        assert methods["least_squares"]["disturbance"] == {}
        found = DisturbanceEstimate.from_json("roll", methods["prediction_error"]["disturbance"]["roll"])
        assert f"Disturbance that prediction_error found beside these: {found}." in Page(report.read_text()).text
        assert f"Disturbance (prediction_error): {found}" in " ".join(self.run(*words).split())

    @pytest.mark.parametrize("command", ["compare", "identify"])
    def test_missing_report_folder_is_a_usage_error(self, command: str, file: Path) -> None:
        self.run(command, file, "--report", "/nowhere/at/all.html", code=2)
