"""The model of a vehicle's actuators that belongs to a model file: read, refused, kept, and written beside it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from model_files import OWN

import upright
from upright.models import library
from upright.models.file.document import ModelFile
from upright.models.file.model_file import load_model, read, write
from upright.models.model import Model
from upright.models.parts import ModelError
from upright.service.offline.model_files import save, started, with_effect, without_effect

LATE = library.get("monocab_gimbals").add("input_delay").change({"input_delay.delay": 0.012})
ROLL = replace(library.get("monocab_roll"), actuators_model=LATE)
MAIN = 'base = "monocab_roll"\nactuators_model = "gimbals.toml"\n'


@pytest.fixture
def main(tmp_path: Path) -> Path:
    write(ModelFile(LATE), tmp_path / "gimbals.toml")
    path = tmp_path / "main.toml"
    path.write_text(MAIN)
    return path


def test_it_is_read_from_the_folder_of_the_file(main: Path) -> None:
    found = load_model(main).actuators_model
    assert found == LATE
    assert read(main).actuators_file == "gimbals.toml"


def test_it_stays_when_effects_are_added_removed_and_undone(main: Path) -> None:
    save(with_effect(started(main), "coulomb_friction"), main)
    assert [each.name for each in load_model(main).effects] == ["coulomb_friction"]
    assert load_model(main).actuators_model == LATE
    save(without_effect(started(main), "coulomb_friction"), main)
    assert (load_model(main).effects, load_model(main).actuators_model) == ((), LATE)


def test_a_copy_in_another_folder_names_the_same_file(main: Path, tmp_path: Path) -> None:
    elsewhere = tmp_path / "copies" / "other.toml"
    elsewhere.parent.mkdir()
    save(started(main), elsewhere)
    assert read(elsewhere).actuators_file == "../gimbals.toml"
    assert load_model(elsewhere).actuators_model == LATE


def test_one_without_a_file_is_written_beside_the_model(tmp_path: Path) -> None:
    upright.Model(ModelFile(ROLL)).save(tmp_path / "mine.toml")
    assert read(tmp_path / "mine.toml").actuators_file == "mine-actuators.toml"
    assert load_model(tmp_path / "mine.toml") == ROLL
    with pytest.raises(ModelError, match="no file is known"):
        write(ModelFile(ROLL), tmp_path / "other.toml")


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (None, r"gimbals\.toml: cannot be read"),
        ("base = ", "is not valid TOML"),
        ('base = "monocab_roll"\n', "no model from a command to the motion that is an input of main"),
        (OWN, "no model from a command to the motion"),
    ],
)
def test_what_is_no_model_of_the_actuators_is_refused(main: Path, content: str | None, message: str) -> None:
    other = main.with_name("gimbals.toml")
    other.unlink()
    if content is not None:
        other.write_text(content)
    with pytest.raises(ModelError, match=message):
        load_model(main)


def test_a_chain_of_three_models_and_a_circle_are_refused(main: Path) -> None:
    beside = main.with_name("gimbals.toml")
    for third in ("more.toml", "gimbals.toml"):
        write(ModelFile(LATE), main.with_name("more.toml"))
        beside.write_text(f'base = "monocab_gimbals"\nactuators_model = "{third}"\n')
        with pytest.raises(ModelError, match="which has no further one"):
            load_model(main)


def test_name_without_the_suffix_is_an_error_with_its_key(main: Path) -> None:
    main.write_text(MAIN.replace("gimbals.toml", "gimbals"))
    with pytest.raises(ModelError, match="actuators_model"):
        load_model(main)


def _shown(model: Model) -> str:
    from rich.console import Console

    from upright.service.pages.model import print_model

    console = Console(record=True, width=120, file=None, quiet=False)
    with console.capture() as captured:
        print_model(model, (), console)
    return captured.get()


def test_model_show_lists_its_effects_apart() -> None:
    assert "The actuators have a model of their own, monocab_gimbals" in _shown(ROLL)
    assert "input_delay.delay" in _shown(ROLL)
    assert "input_delay" not in _shown(library.get("monocab_roll"))
