"""Model files that are written: they are read back unchanged, and comments are kept."""

from __future__ import annotations

import dataclasses
import os
import random
from pathlib import Path

import pytest
from model_files import BASED, BUMP, NOW, OWN, write_based

from upright.models import library
from upright.models.effects.catalogue import CATALOGUE
from upright.models.file.document import ModelFile
from upright.models.file.model_file import parse, read, write
from upright.models.parts import (
    ModelError,
    Place,
)


@pytest.fixture
def based(tmp_path: Path) -> Path:
    return write_based(tmp_path)


@pytest.mark.parametrize("name", library.MODELS)
def test_shipped_model_with_every_effect_survives_writing_and_reading(tmp_path: Path, name: str) -> None:
    model = library.get(name)
    for effect in CATALOGUE.values():
        try:
            model = model.add(effect)
        except ModelError:
            # The axis has no gimbals, and its coordinate is not an angle. Where the gimbals' motion is measured, there
            # is no command. The model of the gimbals alone has a command and nothing else.
            assert name == "axis" or (effect.place is Place.ACTUATOR) == (name == "monocab_roll")
    draw = random.Random(1)
    values = {p.name: max(p.lower, min(p.upper, p.value * draw.uniform(0.9, 1.1) + 1e-3)) for p in model.parameters}
    model = model.change(values, deviations={name: draw.random() for name in values}, estimated=list(values)[::2])
    _round_trip(
        ModelFile(model, ({"action": "x", "date": NOW, "recording": ["a", "b"], "note": 'a "b" \\ c\n'},)), tmp_path
    )


def _round_trip(file: ModelFile, folder: Path) -> str:
    path = folder / "written.toml"
    write(file, path)
    assert read(path) == file
    assert not list(folder.glob(".written*"))
    return path.read_text()


@pytest.mark.parametrize("text", [OWN, BASED], ids=["own", "based"])
def test_file_survives_writing_and_reading_with_or_without_a_base(tmp_path: Path, text: str) -> None:
    file = parse(text, "mine.toml")
    written = _round_trip(file, tmp_path)
    assert ("base =" in written) == (text is BASED)


@pytest.mark.parametrize("name", library.MODELS)
def test_model_that_differs_from_the_shipped_ones_is_written_in_full(tmp_path: Path, name: str) -> None:
    model = library.get(name)
    sharper = tuple(dataclasses.replace(output, noise=output.noise / 2) for output in model.outputs)
    written = _round_trip(ModelFile(dataclasses.replace(model, outputs=sharper, name="mine")), tmp_path)
    assert "base =" not in written


def test_written_file_states_units_and_omits_bounds_and_title_of_the_base(tmp_path: Path) -> None:
    model = dataclasses.replace(library.get("monocab_reduced").add("coulomb_friction"), name="mine")
    text = _round_trip(ModelFile(model), tmp_path)
    assert "inertia = { value = 1450.0, std = 200.0 }" in text
    assert "# kg m^2, about the rail head" in text
    assert "torque = { value = 0.0 }  # N m" in text
    assert "lower" not in text
    assert "title" not in text


def test_edit_changes_only_the_affected_lines(based: Path) -> None:
    file = read(based)
    model = file.model.remove("coulomb_friction").add("viscous_friction").change({"inertia": 1600.0})
    write(ModelFile(model, (*file.history, {"action": "refit", "date": NOW})), based)
    assert based.read_text() == BASED.replace("value = 1500", "value = 1600.0").replace(
        """\
# since the bearings were changed
[[effects]]
name = "coulomb_friction"
at = "roll"
[effects.parameters]
torque = { value = 12.5, std = 1.5 }     # N m

""", "").replace(
        """\
# what was done
""",
        """\
[[effects]]
name = "viscous_friction"
at = "roll"

[effects.parameters]
coefficient = { value = 0.0 }  # N m/(rad/s), COEFFICIENT

# what was done
""".replace("COEFFICIENT", model.parameter("viscous_friction.coefficient").meaning).replace(
            "N m/(rad/s)", model.parameter("viscous_friction.coefficient").unit
        ),
    ) + """
[[history]]
action = "refit"
date = 2026-05-06T07:08:09Z
"""  # fmt: skip
    assert read(based).model == model


def test_new_values_are_added_to_the_file_and_comments_are_kept(based: Path) -> None:
    file = read(based)
    model = file.model.change(
        {"trim_height": 0.5, "static_torque.torque": 7.0}, deviations={"static_torque.torque": 2.0}
    )
    write(dataclasses.replace(file, model=model), based)
    assert read(based).model == model
    text = based.read_text()
    for comment in ("# The vehicle in the hall.", "# weighed", "# since the bearings", "# what was done"):
        assert comment in text


@pytest.mark.parametrize(
    "text",
    [
        'base = "axis"\neffects = [{ name = "static_torque" }]\n',
        'base = "axis"\n[[history]]\naction = "a"\n[[effects]]\nname = "static_torque"\n[[history]]\naction = "b"\n',
        'base = "axis"\n[[effects]]\nname = "static_torque"\nparameters = { torque = { value = 1 } }\n',
        'base = "axis"\neffects = []\nhistory = []\n',
        'base = "axis"\ntitle = """\n[[effects]]\n"""\n',
        "this is = no model file",
    ],
)
def test_unusually_formatted_file_is_rewritten_rather_than_broken(tmp_path: Path, text: str) -> None:
    path = tmp_path / "written.toml"
    path.write_text(text)
    try:
        file = read(path)
    except ModelError:
        file = ModelFile(dataclasses.replace(library.get("axis"), name="written"))
    model = file.model.add("viscous_friction").change({"inertia": 3.0})
    if model.effects[0].name == "static_torque":
        model = model.change({"static_torque.torque": 5.0})
    file = ModelFile(model, (*file.history, {"action": "add"}))
    _round_trip(file, tmp_path)
    path.write_text(text)
    for effect in model.effects:
        file = dataclasses.replace(file, model=file.model.remove(effect.name))
        _round_trip(file, tmp_path)


def test_file_is_replaced_atomically(based: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = read(based)
    based.chmod(0o640)
    link = based.with_name("link.toml")
    link.symlink_to(based)
    write(dataclasses.replace(file, model=file.model.change({"inertia": 1.0})), link)
    assert link.is_symlink()
    assert based.stat().st_mode & 0o777 == 0o640
    before = based.read_text()

    def full(handle: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(ModelError, match=r"cannot be written: No space left"):
        write(file, based)
    assert based.read_text() == before
    assert sorted(path.name for path in based.parent.iterdir()) == ["link.toml", "mine.toml"]
    with pytest.raises(ModelError, match="cannot be written: No such file"):
        write(file, based.parent / "nowhere" / "x.toml")


def test_own_effect_files_are_relative_to_the_folder_of_the_model_file(tmp_path: Path) -> None:
    (tmp_path / "effects").mkdir()
    (tmp_path / "effects" / "bump.toml").write_text(BUMP)
    path = tmp_path / "mine.toml"
    path.write_text(f'{OWN}\n[[effects]]\nfile = "effects/bump.toml"\nparameters.torque.value = 3.0\n')
    file = read(path)
    assert file.model.values["rail_bump.torque"] == 3.0
    assert file.effect_files == {"rail_bump": "effects/bump.toml"}
    _round_trip(file, tmp_path)
    without = dataclasses.replace(file, effect_files={})
    with pytest.raises(ModelError, match=r"effect rail_bump: is not in the catalogue, and no file is known"):
        write(without, tmp_path / "other.toml")
    path.write_text(path.read_text().replace("file =", 'name = "bump"\nfile ='))
    with pytest.raises(ModelError, match=r"effects\.0: .*bump\.toml describes rail_bump"):
        read(path)
    (tmp_path / "effects" / "bump.toml").write_text(BUMP.replace("** 2", "** 4"))
    with pytest.raises(ModelError, match="now describes another effect"):
        write(file, tmp_path / "other.toml")
