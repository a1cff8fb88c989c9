"""Models of the library: loaded, changed, saved; and effects of one's own, as a file and as an object."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import pytest

import upright

RUBBING = upright.Effect(
    name="rubbing",
    family=upright.Family.DRY_FRICTION,
    title="a brush that rubs",
    place=upright.Place.JOINT,
    equation="F = -torque sgn(rate)",
    force="-torque * rate / sqrt(rate ** 2 + smooth_rate ** 2)",
    parameters=(
        upright.EffectParameter(
            "torque", "{force}", "of the brush", amplitude=True, scale="force_scale / 10", lower="0"
        ),
    ),
    signature="a square wave",
    confused_with=(),
    separated_by="",
)
RUBBING_TOML = """name = "rubbing"
family = "dry_friction"
title = "a brush that rubs"
place = "joint"
equation = "F = -torque sgn(rate)"
force = "-torque * rate / sqrt(rate ** 2 + smooth_rate ** 2)"
signature = "a square wave"

[[parameters]]
name = "torque"
unit = "{force}"
meaning = "of the brush"
amplitude = true
scale = "force_scale / 10"
lower = "0"
"""


@pytest.fixture
def model(folder: Path) -> upright.Model:
    return upright.Model.load(folder / "pendulum.toml")


def test_a_model_shows_its_parameters(model: upright.Model) -> None:
    assert str(model.parameters["inertia"]) == "0.50 ± 0.10 kg m^2"
    assert "stiffness" in str(model)
    assert "stiffness" in model._repr_html_()
    assert repr(model) == "Model('pendulum', effects=[])"
    table = model.to_frame()
    assert list(table["parameter"]) == list(model.parameters)


def test_a_model_is_never_changed(model: upright.Model) -> None:
    heavier = model.change({"inertia": 0.7}).add("coulomb_friction")
    assert heavier.parameters["inertia"].value == 0.7
    assert heavier.effects == ("coulomb_friction",)
    assert model.effects == ()
    assert heavier.remove("coulomb_friction").effects == ()
    assert [entry["action"] for entry in heavier.remove("coulomb_friction").history] == ["add", "remove"]


def test_a_saved_model_is_the_same_model(model: upright.Model, tmp_path: Path) -> None:
    path = model.add("coulomb_friction").save(tmp_path / "repaired.toml")
    again = upright.Model.load(path)
    assert again.effects == ("coulomb_friction",)
    assert again.parameters == model.add("coulomb_friction").parameters
    assert [each.name for each in tmp_path.iterdir()] == ["repaired.toml"]


def test_a_shipped_model_has_the_values_of_a_vehicle() -> None:
    assert upright.Model.load(vehicle="monocab").parameters["inertia"].value == 1450.0
    assert "inertia" in upright.Model.load("monocab_roll").parameters


@pytest.mark.parametrize(
    ("wrong", "remedy"),
    [
        (lambda model: upright.Model.load(), "give a model, or the vehicle"),
        (lambda model: upright.Model.load("pendulum"), "Remedy: "),
        (lambda model: model.add("coulomb_frction"), "did you mean coulomb_friction"),
        (lambda model: model.remove("backlash"), "its effects: none"),
        (lambda model: model.change({"mass": 1.0}), "use one of: inertia"),
        (lambda model: model.save("model.json"), "use the suffix .toml"),
    ],
)
def test_an_error_names_the_remedy(model: upright.Model, wrong: object, remedy: str) -> None:
    assert callable(wrong)
    with pytest.raises(upright.UprightError, match=remedy):
        wrong(model)


def test_an_effect_of_ones_own_is_the_same_as_a_file_and_as_an_object(model: upright.Model, tmp_path: Path) -> None:
    file = tmp_path / "rubbing.toml"
    file.write_text(RUBBING_TOML)
    assert model.add(file).parameters == model.add(RUBBING).parameters


def test_a_model_finds_the_file_of_an_effect_from_another_folder(model: upright.Model, tmp_path: Path) -> None:
    file = tmp_path / "effects" / "rubbing.toml"
    file.parent.mkdir()
    file.write_text(RUBBING_TOML)
    saved = model.add(file).save(tmp_path / "repaired.toml")
    assert 'file = "effects/rubbing.toml"' in saved.read_text()
    (tmp_path / "models").mkdir()
    elsewhere = upright.Model.load(saved).save(tmp_path / "models" / "moved.toml")
    assert upright.Model.load(elsewhere).effects == ("rubbing",)


def test_an_effect_that_is_an_object_cannot_be_saved(model: upright.Model, tmp_path: Path) -> None:
    with pytest.raises(upright.UprightError, match="write it into a file of its own"):
        model.add(RUBBING).save(tmp_path / "repaired.toml")
    assert list(tmp_path.iterdir()) == []


def test_an_effect_is_checked_like_one_in_a_file(model: upright.Model) -> None:
    with pytest.raises(upright.UprightError, match="multiply the term that it adds by an amplitude"):
        model.add(replace(RUBBING, force="-torque * rate + 1"))
    with pytest.raises(upright.UprightError, match="the catalogue has another effect of this name"):
        model.add(replace(RUBBING, name="backlash"))


def test_a_python_file_that_nobody_allowed_does_not_run(model: upright.Model, tmp_path: Path) -> None:
    file = tmp_path / "rubbing.py"
    file.write_text("from pathlib import Path\nPath(__file__).with_suffix('.ran').touch()\n")
    with pytest.raises(upright.UprightError, match="upright model allow"):
        model.add(file)
    assert [each.name for each in tmp_path.iterdir()] == ["rubbing.py"]


def test_the_effect_of_the_manual_can_be_added(model: upright.Model) -> None:
    manual = Path(__file__).resolve().parents[2] / "docs" / "how-to" / "use-from-python.md"
    (definition,) = re.findall(r"^bump = (.*?^\))", manual.read_text(), re.DOTALL | re.MULTILINE)
    bump = eval(definition, {"upright": upright})
    assert [name for name in model.add(bump).parameters if "." in name] == ["rail_bump.torque", "rail_bump.width"]
