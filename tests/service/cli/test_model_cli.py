"""`upright model`: new, add, remove, show and list, and the examples of the manual."""

from __future__ import annotations

import json
import re
import sys
from datetime import UTC, datetime
from pathlib import Path

import pytest
from model_files import BUMP, write_based
from typer.testing import CliRunner

from upright.models.effects.catalogue import CATALOGUE
from upright.models.file.model_file import load_model, parse, read
from upright.models.parts import (
    Disturbance,
    ModelError,
)
from upright.service import cli
from upright.vehicles.file import load

REPOSITORY = Path(__file__).resolve().parents[3]


@pytest.fixture
def based(tmp_path: Path) -> Path:
    return write_based(tmp_path)


def upright(*arguments: object) -> str:
    """The stdout of the command; exceptions are raised unchanged."""
    result = CliRunner().invoke(cli.app, ["model", *map(str, arguments)])
    if result.exception is not None:
        raise result.exception
    return result.stdout


def test_new_uses_the_vehicles_values_and_overwrites_nothing(tmp_path: Path) -> None:
    path = tmp_path / "my hall.toml"
    vehicle = tmp_path / "heavy.toml"
    shipped = Path(load("monocab").path).read_text()
    vehicle.write_text(
        shipped.replace("inertia = { value = 1450.0, std = 200.0", "inertia = { value = 2000.0, std = 9.0")
    )
    upright("new", path, "--base", "monocab_reduced", "--vehicle", vehicle)
    model = read(path).model
    assert model.name == "my_hall"
    assert (model.parameter("inertia").value, model.parameter("inertia").std) == (2000.0, 9.0)
    assert model.parameter("speed_loop_lag").value == 0.04
    assert read(path).history[0]["action"] == "new"
    before = path.read_text()
    with pytest.raises(ModelError, match="already exists"):
        upright("new", path, "--base", "axis")
    assert path.read_text() == before
    with pytest.raises(ModelError, match=r"use the suffix \.toml"):
        upright("new", tmp_path / "mine", "--base", "axis")
    with pytest.raises(ModelError, match="there is no such model"):
        upright("new", tmp_path / "other.toml", "--base", "monocab")
    assert not (tmp_path / "other.toml").exists()


def test_add_and_remove_update_effects_and_history(based: Path) -> None:
    assert "coefficient" in upright("add", based, "viscous_friction", "--at", "roll")
    file = read(based)
    assert file.model.effects[-1].name == "viscous_friction"
    assert file.history[-1]["action"] == "add"
    assert abs(file.history[-1]["date"] - datetime.now(UTC)).total_seconds() < 60
    answer = json.loads(upright("remove", based, "coulomb_friction", "--json"))
    assert answer == {
        "file": str(based), "removed": "coulomb_friction", "effects": ["static_torque", "viscous_friction"],
    }  # fmt: skip
    assert "# weighed" in based.read_text()
    assert [entry["action"] for entry in read(based).history] == ["add", "add", "remove"]
    for arguments, said in (
        (("add", based, "viscous_friction"), "has it already"),
        (("add", based, "viscos_friction"), "did you mean viscous_friction"),
        (("add", based, "sensor_offset", "--at", "gimbals"), "there is no sensor 'gimbals'"),
        (("add", based, "quadratic_drag", "--at", "gimbals"), "there is no joint 'gimbals'"),
        (("remove", based, "coulomb_friction"), "its effects: static_torque, viscous_friction"),
    ):
        before = based.read_text()
        with pytest.raises(ModelError, match=said):
            upright(*arguments)
        assert based.read_text() == before


def test_add_stores_an_effect_file_relative_to_the_model_file(based: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = based.parent / "effects"
    folder.mkdir()
    (folder / "bump.toml").write_text(BUMP)
    monkeypatch.chdir(folder)
    answer = json.loads(upright("add", based, "bump.toml", "--json"))
    assert (answer["effect"], answer["at"]) == ("rail_bump", "roll")
    assert answer["parameters"]["rail_bump.width"]["unit"] == "rad"
    assert 'file = "effects/bump.toml"' in based.read_text()
    upright("remove", based, "rail_bump")
    assert read(based).effect_files == {}


def test_show_prints_text_latex_and_json(based: Path) -> None:
    text = upright("show", based, "--effect", "quadratic_drag@roll")
    for part in ("coulomb_friction.torque", "12.5", "sweep.arrow", "who me", "mass x g x"):
        assert part in text
    assert r"\begin{align*}" in upright("show", "axis", "--format", "latex", "--effect", "static_torque")
    document = json.loads(upright("show", based, "--json"))
    assert document == json.loads(upright("show", based, "--format", "json"))
    assert document["parameters"]["coulomb_friction.torque"] | {"meaning": ""} == {
        "unit": "N m", "value": 12.5, "std": 1.5, "lower": 0.0, "upper": None, "estimated": True, "scale": 100.0,
        "meaning": "",
    }  # fmt: skip
    assert document["history"][0]["effect"] == "coulomb_friction"
    assert {
        "kind": "effect",
        "name": "static_torque",
        "expression": "static_torque.torque",
        "effect": "static_torque",
    } in (document["equations"])
    with pytest.raises(ModelError, match="did you mean"):
        upright("show", "axis", "--effect", "static_torqe")


def test_list_effects_prints_the_catalogue_or_one_family() -> None:
    document = json.loads(upright("list-effects", "--json"))
    assert [each["name"] for each in document["effects"]] == list(CATALOGUE)
    assert all(each["equation"] and each["parameters"] and each["separated_by"] for each in document["effects"])
    text = upright("list-effects", "--family", "time_shift")
    assert "input_delay" in text
    assert "coulomb_friction (" not in text
    result = CliRunner().invoke(cli.app, ["model", "list-effects", "--family", "friction"])
    assert result.exit_code == 2


def test_error_is_printed_as_a_sentence_with_exit_code_1(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", ["upright", "model", "show", "nowhere.toml"])
    with pytest.raises(SystemExit) as caught:
        cli.main()
    assert caught.value.code == 1
    assert capsys.readouterr().err.startswith("upright: nowhere.toml: cannot be read: No such file or directory.")


def _blocks(page: str, marker: str) -> list[str]:
    return re.findall(rf"```{marker}\n(.*?)```", (REPOSITORY / "docs" / page).read_text(), re.S)


def test_examples_in_the_manual_are_valid_models(tmp_path: Path) -> None:
    pendulum, dent = _blocks("how-to/write-your-own-model.md", "toml")
    (tmp_path / "pendulum.toml").write_text(pendulum)
    (tmp_path / "bump.toml").write_text(dent)
    upright("add", tmp_path / "pendulum.toml", tmp_path / "bump.toml")
    model = load_model(tmp_path / "pendulum.toml")
    assert [effect.name for effect in model.effects] == ["bearing_dent"]
    assert model.add("input_deadband").add("sensor_offset").values["input_deadband.width"] == 0.0
    based, disturbance = _blocks("reference/model-file.md", "toml")
    assert parse(based, "hall.toml").model.values["coulomb_friction.torque"] == 12.5
    (joint,) = parse(f'base = "monocab_roll"\n{disturbance}', "hall.toml").model.joints
    assert joint.disturbance == Disturbance(8.0, 0.3)
