"""Effects of one's own, from TOML and Python files: attached, allowed, and refused with file, key and remedy."""

from __future__ import annotations

from pathlib import Path

import pytest
from model_files import BUMP

from upright.models.compiler.equations import compose
from upright.models.file.allowed_code import allow, sha256
from upright.models.file.model_file import load_model
from upright.models.file.own_effects import load_effect
from upright.models.library import get
from upright.models.parts import ModelError

REPOSITORY = Path(__file__).resolve().parents[2]
MONOCAB = get("monocab_reduced")


def _file(folder: Path, text: str, name: str = "own.toml") -> Path:
    path = folder / name
    path.write_text(text)
    return path


def test_effect_from_a_toml_file_works_beside_the_catalogues(tmp_path: Path) -> None:
    effect = load_effect(_file(tmp_path, BUMP))
    assert effect.equation == "force = -torque * exp(-(coordinate / width) ** 2)"
    model = MONOCAB.add(effect).add("coulomb_friction")
    assert model.values["rail_bump.width"] == 0.002
    assert model.parameter("rail_bump.torque").unit == "N m"
    (term, _) = compose(model).forces["roll"]
    assert term[0] == "rail_bump"
    assert load_effect(tmp_path / "own.toml") == effect


def test_key_of_an_earlier_version_is_accepted(tmp_path: Path) -> None:
    assert load_effect(_file(tmp_path, "strikes = true\n" + BUMP)).impacts


def test_example_in_the_manual_is_a_valid_effect(tmp_path: Path) -> None:
    page = (REPOSITORY / "docs" / "reference" / "effects.md").read_text()
    example = page.split("```toml\n")[1].split("```")[0]
    assert load_effect(_file(tmp_path, example)).name == "rail_bump"


def test_effect_from_a_toml_file_can_have_states(tmp_path: Path) -> None:
    memory = BUMP.replace("coordinate / width", "z / width") + (
        '[[states]]\nname = "z"\nunit = "{coordinate}"\nderivative = "(coordinate - z) / 0.5 + 0 * force"\n'
    )
    model = MONOCAB.add(load_effect(_file(tmp_path, memory)))
    assert model.states[-1].name == "rail_bump.z"
    assert len(compose(model).derivatives) == len(MONOCAB.states) + 1


PYTHON = """
from upright.models.effect import Effect, EffectParameter, Family
from upright.models.parts import Place
EFFECT = Effect(
    name="wind", family=Family.BIAS, title="gusts", place=Place.JOINT, equation="F = torque",
    parameters=(EffectParameter("torque", "{force}", "of the wind", amplitude=True, scale="force_scale"),),
    signature="", confused_with=("static_torque",), separated_by="", force="torque * sin(time) ** 2",
)
"""


def test_effect_from_a_python_file_can_be_attached(tmp_path: Path) -> None:
    effect = load_effect(_file(tmp_path, PYTHON, "wind.py"), allow=True)
    assert MONOCAB.add(effect).effects[0].amplitudes == ("wind.torque",)


def test_python_file_runs_only_as_it_was_allowed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    ran = tmp_path / "ran"
    path = _file(tmp_path, f"import os\nos.mkdir({str(ran)!r})\n{PYTHON}", "wind.py")
    (tmp_path / "theirs.toml").write_text('base = "axis"\n[[effects]]\nfile = "wind.py"\n')
    for read in (load_effect, lambda path: load_model(path.with_name("theirs.toml"))):
        with pytest.raises(ModelError, match=rf"{sha256(path.read_bytes())}.*was not allowed.*upright model allow"):
            read(path)
    assert not ran.exists()
    assert allow(path) == allow(path) == sha256(path.read_bytes())
    assert load_model(tmp_path / "theirs.toml").effects[0].name == "wind"
    assert ran.is_dir()
    path.write_text(path.read_text() + "# changed\n")
    with pytest.raises(ModelError, match="has changed since"):
        load_effect(path)


@pytest.mark.parametrize("mode", [0o666, 0o620])
def test_list_of_allowed_files_that_others_can_write_does_not_count(
    tmp_path: Path, mode: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    path = _file(tmp_path, PYTHON, "wind.py")
    allow(path)
    (tmp_path / "state" / "upright" / "allowed-python").chmod(mode)
    with pytest.raises(ModelError, match="was not allowed"):
        load_effect(path)
    with pytest.raises(ModelError, match="others could have written"):
        allow(path)


@pytest.mark.parametrize(
    ("old", "new", "where", "what"),
    [
        ("[[parameters]]", "[[parameters", "own.toml", "is not TOML .*line"),
        ('title = "a dent in the rail head"\n', "", "own.toml: title", "is missing"),
        ("force =", "forces =", "own.toml: forces", "did you mean force"),
        ('meaning = "of the dent"', 'meant = "x"', "own.toml: parameters.1: meant", "did you mean meaning"),
        ('family = "stiffness"', 'family = "springs"', "own.toml: family", "use one of: bias, "),
        ('place = "joint"', 'place = "rail"', "own.toml: place", "use one of: joint, actuator, sensor"),
        ('place = "joint"', 'place = "sensor"', "own.toml: effect rail_bump", "where force has no meaning"),
        ("coordinate / width", "coordinate / breadth", "own.toml: effect rail_bump, force", "there is no 'breadth'"),
        ("-torque *", "__import__('os') *", "own.toml: effect rail_bump, force", "Remedy"),
        ("-torque *", "(-torque - 1) *", "own.toml: effect rail_bump, force", "is not 0 if torque is 0"),
        ("coordinate / width", "sqrt(-1 - time)", "own.toml: effect rail_bump, force", "has no value"),
        ("amplitude = true", "amplitude = 1", "own.toml: parameters.0: amplitude", "neither true nor false"),
        ("amplitude = true\n", "", "own.toml: effect rail_bump, parameters", "none is an amplitude"),
        ("amplitude = true", "amplitude = true\nvalue = 3", "parameter torque, value", "begins at 0"),
        ('scale = "force_scale"', 'scale = "force"', "parameter torque, scale", "there is no 'force'"),
        ('scale = "force_scale"\n', "", "parameter torque, scale", "a typical magnitude"),
        ("{coordinate}", "{furlong}", "parameter width, unit", "there is no {furlong} on joints"),
        ("{coordinate}", "{coordinate", "parameter width, unit", "cannot be filled in"),
        ("value = 0.002", "value = 0.002\nlower = 0.01", "parameter width, value", "outside its bounds"),
        ("value = 0.002", "value = [1]", "own.toml: parameters.1: value", "is not text"),
        ('["position_cogging"]', '["cogs"]', "effect rail_bump, confused_with", "no other effect 'cogs'"),
        ('["position_cogging"]', '"position_cogging"', "own.toml: confused_with", "is not a list"),
        ('name = "width"', 'name = "rate"', "parameter rate", "is predefined"),
        ('name = "width"', 'name = "torque"', "parameter torque", "is defined twice"),
        ('name = "rail_bump"', 'name = "rail bump"', "own.toml: effect rail bump, name", "is not a valid name"),
        ('name = "rail_bump"', 'name = "backlash"', "own.toml: name", "the catalogue has an effect backlash"),
        ('place = "joint"', 'place = "joint"\nin_radians = ["roll"]', "in_radians", "there is no 'roll' on joints"),
    ],
)
def test_invalid_effect_file_is_refused_with_file_key_and_remedy(
    tmp_path: Path, old: str, new: str, where: str, what: str
) -> None:
    assert old in BUMP
    path = _file(tmp_path, BUMP.replace(old, new, 1))
    with pytest.raises(ModelError, match=what) as caught:
        load_effect(path)
    assert str(path) in caught.value.where
    assert caught.value.where.endswith(where.removeprefix("own.toml"))
    assert caught.value.remedy


def test_parameters_that_are_not_a_list_of_tables_are_refused(tmp_path: Path) -> None:
    text = BUMP.split("[[parameters]]")[0] + 'parameters = ["torque"]\n'
    with pytest.raises(ModelError, match="is not a list of tables"):
        load_effect(_file(tmp_path, text))


@pytest.mark.parametrize(
    ("text", "what"),
    [
        ("EFFECT = Effect(", "SyntaxError"),
        ("raise SystemExit(3)", "SystemExit"),
        ("effect = 1", "does not define EFFECT"),
        ("EFFECT = {}", "is a dict, not an Effect"),
        (PYTHON.replace("torque * sin", "sin"), "is not 0 if torque is 0"),
    ],
)
def test_invalid_python_file_is_refused(tmp_path: Path, text: str, what: str) -> None:
    path = _file(tmp_path, text, "own.py")
    with pytest.raises(ModelError, match=what) as caught:
        load_effect(path, allow=True)
    assert str(path) in caught.value.where
    assert caught.value.remedy


@pytest.mark.parametrize(
    ("name", "what"), [("none.toml", "cannot be read"), ("none.py", "cannot be read"), ("x", "ending")]
)
def test_missing_file_or_unknown_suffix_is_refused(tmp_path: Path, name: str, what: str) -> None:
    with pytest.raises(ModelError, match=what):
        load_effect(tmp_path / name)
