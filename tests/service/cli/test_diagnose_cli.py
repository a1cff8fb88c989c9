"""`upright diagnose` on the command line."""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner
from virtual_records import multisine
from written_report import found, of_little_matter

from upright.diagnosis import parts
from upright.models.file.model_file import read
from upright.service.cli import app
from upright.service.offline.diagnose import default_budget
from upright.service.pages.diagnose import print_diagnosis
from upright.service.virtual.run import record
from upright.telemetry.storage import save

EFFECTS = ("--effect", "viscous_friction", "--effect", "quadratic_drag")
UNHURRIED = ("--budget", "inf")
"""No time limit, since the machine may be busy: the test checks what is found, not how fast."""
OTHERS = (
    "roll",
    "roll_rate",
    "precession",
    "precession_rate",
    "precession_rate_setpoint",
    "trim_position",
    "trim_rate",
    "trim_rate_setpoint",
)
OWN = """name = "wheel_drag"
family = "speed_drag"
title = "drag of a wheel"
place = "joint"
equation = "F = -drag rate"
force = "-drag * rate"
signature = "A force against the rate."
confused_with = ["viscous_friction"]
separated_by = "Nothing."

[[parameters]]
name = "drag"
unit = "{force} s/{coordinate}"
meaning = "of it"
amplitude = true
scale = "100"
"""


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("diagnose") / "multisine.arrow"
    save(multisine("viscous_friction"), path)
    return path


def upright(*arguments: Any, code: int = 0) -> str:
    done = CliRunner().invoke(app, ["diagnose", *map(str, arguments)], catch_exceptions=False)
    assert done.exit_code == code, done.output
    return done.stdout


def test_text_output_has_the_findings_and_the_disturbance(recording: Path) -> None:
    text = upright(recording, *EFFECTS)
    for part in ("missing effect", "1. viscous_friction", "Normalised innovation", "Minimum detectable", "N m s/rad"):
        assert part in text
    said = " ".join(text.split())
    assert "Disturbance: " in said
    assert "The best possible prediction 0.5 s ahead has " in said
    assert " of the error energy 0.5 s ahead, and " in said  # the recording contains its control loop
    assert "Left untried" not in said


@dataclass(frozen=True, slots=True)
class Written:
    """What one diagnosis answers and writes."""

    document: Any
    model: Path
    report: Path


@pytest.fixture(scope="module")
def written(recording: Path, tmp_path_factory: pytest.TempPathFactory) -> Written:
    folder = tmp_path_factory.mktemp("written")
    model, report = folder / "repaired.toml", folder / "diagnosis.html"
    asked = (*EFFECTS, *UNHURRIED, "--auto", model, "--report", report, "--json")
    return Written(json.loads(upright(recording, *asked)), model, report)


def test_json_has_the_disturbance_and_the_relevance_of_a_finding(written: Written) -> None:
    document = written.document
    assert document["untried"] == []
    assert document["disturbance"]["roll"]["unit"] == "N m"
    assert set(document["prediction_limit"]["rmse"]) == {"roll", "roll_rate"}
    relevance = document["findings"][0]["relevance"]
    assert relevance["horizon"] == 0.5
    assert relevance["ahead_percent"] > 1.0
    assert relevance["closed_loop_percent"] > 1.0
    assert not relevance["negligible"]


def test_exhausted_budget_lists_what_was_left_untried_and_a_remedy(recording: Path) -> None:
    """The choice of the next experiment alone takes longer."""
    text = " ".join(upright(recording, "--budget", "2").split())
    assert "Left untried for want of time (2 s): " in text
    assert "Remedy: --budget 10." in text


def test_zero_budget_is_a_usage_error(recording: Path) -> None:
    upright(recording, "--budget", "0", code=2)


def test_default_budget_grows_with_the_number_of_samples() -> None:
    rows = len(multisine("viscous_friction"))
    assert default_budget([multisine("viscous_friction")]) == pytest.approx(60.0 * max(1.0, rows / 12_000))
    assert default_budget([multisine("viscous_friction")] * 10) == pytest.approx(600.0 * rows / 12_000)


def test_negligible_effect_is_listed_separately_below_the_headline(capsys: pytest.CaptureFixture[str]) -> None:
    print_diagnosis(of_little_matter(), 60.0)
    text = " ".join(capsys.readouterr().out.split())
    assert text.startswith("negligible effect: nothing is missing that matters.")
    above, below = text.split("Negligible: significant, but less than 1 % of the error")
    assert "coulomb_friction" not in above
    assert "1. coulomb_friction" in below


def test_named_effect_is_first_and_marked_whatever_the_odds_of_the_others(capsys: pytest.CaptureFixture[str]) -> None:
    """Another effect may fit better, but has failed a check."""
    whole = found()
    first, *rest = whole.findings
    likelier = replace(first, odds={"hysteresis": 3.0, **first.odds})
    print_diagnosis(replace(whole, findings=(likelier, *rest)), 60.0)
    below = capsys.readouterr().out.partition(f"1. {first.effect}")[2].splitlines()
    assert below[1].split()[0] == first.effect
    assert below[1].rstrip().endswith("named")
    assert below[2].split()[0] == "hysteresis"


def test_model_trail_and_report_are_written_with_the_finding(written: Written) -> None:
    document, model = written.document, written.model
    assert document["verdict"] == "missing_effect"
    assert document["findings"][0]["effect"] == "viscous_friction"
    file = read(model)
    assert [each.name for each in file.model.effects] == ["viscous_friction"]
    found = document["findings"][0]["parameters"]["viscous_friction.coefficient"]["value"]
    assert file.model.values["viscous_friction.coefficient"] == pytest.approx(found)
    assert [entry["action"] for entry in file.history] == ["add"]
    trail = json.loads(model.with_suffix(".trail.json").read_text())
    assert trail["findings"] == document["findings"]
    assert len(trail["recordings"]["multisine.arrow"]) == 64
    page = written.report.read_text()
    assert "viscous_friction" in page
    assert trail["recordings"]["multisine.arrow"] in page


def test_recording_may_be_deleted_during_the_search(
    recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It is needed only until it has been read: the search takes minutes, in which a user may delete it."""
    path, model, report = tmp_path / "gone.arrow", tmp_path / "repaired.toml", tmp_path / "diagnosis.html"
    path.write_bytes(recording.read_bytes())
    search = parts.diagnose_parts

    def delete_and_search(*arguments: Any, **named: Any) -> Any:
        path.unlink()
        return search(*arguments, **named)

    monkeypatch.setattr(parts, "diagnose_parts", delete_and_search)
    upright(path, *EFFECTS, "--auto", model, "--report", report)
    sha256 = hashlib.sha256(recording.read_bytes()).hexdigest()
    assert json.loads(model.with_suffix(".trail.json").read_text())["recordings"] == {"gone.arrow": sha256}
    assert sha256 in report.read_text()


def test_user_defined_effect_is_found_and_written_to_the_model(recording: Path, tmp_path: Path) -> None:
    own = tmp_path / "wheel_drag.toml"
    own.write_text(OWN)
    model = tmp_path / "repaired.toml"
    asked = ("--effect", "quadratic_drag", "--also", own, "--auto", model, "--json")
    assert json.loads(upright(recording, *asked))["findings"][0]["effect"] == "wheel_drag"
    file = read(model)
    assert [each.name for each in file.model.effects] == ["wheel_drag"]
    assert file.effect_files == {"wheel_drag": "wheel_drag.toml"}


def test_missing_report_folder_is_a_usage_error(recording: Path, tmp_path: Path) -> None:
    done = CliRunner().invoke(app, ["diagnose", str(recording), "--report", str(tmp_path / "nowhere" / "page.html")])
    assert done.exit_code == 2
    assert "there is no folder" in done.output.replace("\n", " ")


def test_insufficient_data_end_with_exit_code_1_and_a_remedy(tmp_path: Path) -> None:
    short = multisine()
    path = tmp_path / "short.csv"
    rows = short.time < 8.0
    names = short.channels.names
    lines = [",".join(("time", *names))]
    lines += [
        ",".join(f"{value:.9g}" for value in row)
        for row in zip(short.time[rows], *(short[name][rows] for name in names), strict=True)
    ]
    path.write_text("\n".join(lines) + "\n")
    text = upright(path, code=1)
    assert "insufficient data" in text
    assert "Remedy" in text


def test_unknown_effect_is_refused_with_a_hint(recording: Path) -> None:
    done = CliRunner().invoke(app, ["diagnose", str(recording), "--effect", "viscos_friction"])
    assert done.exit_code != 0
    assert "viscous_friction" in str(done.exception)


def test_foreign_csv_with_white_roll_noise_and_no_drive_age_is_diagnosed(tmp_path: Path) -> None:
    """The nine channels of the contract as CSV, with roll measured independently of the gyro: 0.01 deg of white noise.

    A model of the project's own filter would expect roll to equal the integrated gyro to a millionth of a radian.
    """
    known = multisine("viscous_friction")
    rng = np.random.default_rng(5)
    columns = {name: known[name].copy() for name in OTHERS}
    columns["roll"] += rng.normal(0.0, np.radians(0.01), len(known))
    path = tmp_path / "other.csv"
    table = np.column_stack([known.time, *columns.values()])
    np.savetxt(path, table, delimiter=",", header=",".join(("time", *OTHERS)), comments="", fmt="%.9g")
    done = CliRunner().invoke(app, ["diagnose", str(path), *EFFECTS, "--json"], catch_exceptions=False)
    assert done.exit_code == 0, done.output
    assert "no channel drive_age" in done.stderr
    document = json.loads(done.stdout)
    assert document["verdict"] == "missing_effect"
    assert [each["effect"] for each in document["findings"]] == ["viscous_friction"]
    assert 0.9 < document["innovation_ratio_after"] < 1.1


def test_effect_that_starts_during_the_run_is_reported_and_found_in_the_rest(tmp_path: Path) -> None:
    path = tmp_path / "late.arrow"
    save(record("monocab", "multisine", hide=["viscous_friction=2@20"], seed=4, duration=40.0), path)
    first = json.loads(upright(path, *EFFECTS, *UNHURRIED, "--json"))
    assert first["verdict"] == "unknown"
    assert "viscous_friction sets in at" in first["reason"]
    begin = first["reason"].rsplit("--from ", 1)[1].rstrip(".")
    rest = json.loads(upright(path, *EFFECTS, "--from", begin, "--json"))
    assert rest["verdict"] == "missing_effect"
    assert rest["findings"][0]["effect"] == "viscous_friction"
    refused = CliRunner().invoke(app, ["diagnose", str(path), "--from", "99"])
    assert refused.exit_code != 0
    assert "has no rows from 99" in str(refused.exception)


def test_user_defined_effect_is_found_beside_one_of_the_catalogue(tmp_path: Path) -> None:
    """It is not in the catalogue, whichever of the two is found first."""
    path, own = tmp_path / "two.arrow", tmp_path / "wheel_drag.toml"
    save(multisine("viscous_friction", "static_torque"), path)
    own.write_text(OWN)
    document = json.loads(upright(path, "--effect", "static_torque", "--effect", own, "--json"))
    assert {each["effect"] for each in document["findings"]} == {"static_torque", "wheel_drag"}


def test_input_delay_is_found_in_the_gimbal_model_and_reported(tmp_path: Path) -> None:
    """The model that starts from the measured gimbals lacks nothing: the report is about the model of the gimbals."""
    path, report = tmp_path / "late.arrow", tmp_path / "report.html"
    save(record("monocab", "multisine", hide=["input_delay"], seed=6, duration=30.0), path)
    document = json.loads(upright(path, *UNHURRIED, "--report", report, "--json"))
    assert [each["effect"] for each in document["findings"]] == ["input_delay"]
    # 12 ms in the plant.
    assert document["findings"][0]["parameters"]["input_delay.delay"]["value"] == pytest.approx(0.012, abs=0.003)
    assert document["suggested_experiment"] is None
    text = report.read_text()
    assert "the model lacks input_delay" in text
    assert "monocab_gimbals" in text
    assert not (tmp_path / "report-2.html").exists()
