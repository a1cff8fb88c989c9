"""`upright diagnose` as it is typed."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from models.model_file import read
from service.cli import app
from tests.virtual_records import multisine

EFFECTS = ("--effect", "viscous_friction", "--effect", "quadratic_drag")
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
    multisine("viscous_friction").save(path)
    return path


def upright(*arguments: Any, code: int = 0) -> str:
    done = CliRunner().invoke(app, ["diagnose", *map(str, arguments)], catch_exceptions=False)
    assert done.exit_code == code, done.output
    return done.stdout


def test_for_people(recording: Path) -> None:
    text = upright(recording, *EFFECTS)
    for part in ("missing effect", "1. viscous_friction", "Innovation energy", "smallest effects", "N m s/rad"):
        assert part in text


def test_everything_that_is_written(recording: Path, tmp_path: Path) -> None:
    model, report = tmp_path / "repaired.toml", tmp_path / "diagnosis.html"
    document = json.loads(upright(recording, *EFFECTS, "--auto", model, "--report", report, "--json"))
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
    page = report.read_text()
    assert "viscous_friction" in page
    assert trail["recordings"]["multisine.arrow"] in page


def test_an_effect_of_ones_own(recording: Path, tmp_path: Path) -> None:
    own = tmp_path / "wheel_drag.toml"
    own.write_text(OWN)
    model = tmp_path / "repaired.toml"
    asked = ("--effect", "quadratic_drag", "--also", own, "--auto", model, "--json")
    assert json.loads(upright(recording, *asked))["findings"][0]["effect"] == "wheel_drag"
    file = read(model)
    assert [each.name for each in file.model.effects] == ["wheel_drag"]
    assert file.effect_files == {"wheel_drag": "wheel_drag.toml"}


def test_a_folder_that_is_not_there_is_said_before_the_work(recording: Path, tmp_path: Path) -> None:
    done = CliRunner().invoke(app, ["diagnose", str(recording), "--report", str(tmp_path / "nowhere" / "page.html")])
    assert done.exit_code == 2
    assert "there is no folder" in done.output.replace("\n", " ")


def test_data_that_cannot_tell_end_with_1_and_the_reason(tmp_path: Path) -> None:
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


def test_an_unknown_effect_is_refused_with_a_hint(recording: Path) -> None:
    done = CliRunner().invoke(app, ["diagnose", str(recording), "--effect", "viscos_friction"])
    assert done.exit_code != 0
    assert "viscous_friction" in str(done.exception)
