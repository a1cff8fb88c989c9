"""Model files: a written model is read back unchanged, comments are kept, and errors name the key and a remedy."""

from __future__ import annotations

import dataclasses
import json
import math
import os
import random
import re
import sys
import tomllib
from collections.abc import Mapping
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pytest
import sympy
from typer.testing import CliRunner

from upright.models import library, rendering
from upright.models.compiler.fingerprint import fingerprint
from upright.models.effects.catalogue import CATALOGUE
from upright.models.file import sections as model_sections
from upright.models.file.document import ModelFile
from upright.models.file.model_file import load_model, parse, read, write
from upright.models.model import Model
from upright.models.parts import (
    Actuator,
    Disturbance,
    Input,
    Joint,
    ModelError,
    Output,
    Parameter,
    Place,
    Sensor,
    State,
)
from upright.models.text.expressions import number
from upright.service import cli
from upright.vehicles.file import load

OWN = """
title = "Pendulum on a motor"    # my own

[definitions]
pull = "mass * 9.81 * arm"
torque = "motor_constant * voltage"

[parameters]
mass = { unit = "kg", value = 2.0, std = 0.1, lower = 0.0, meaning = "of the bob" }
arm = { unit = "m", value = 0.5, estimated = false }
motor_constant = { unit = "N m/V", value = 0.3, std = 0.05 }
late = { unit = "s", value = 0.001, lower = 0.0, upper = 0.05 }

[states]
angle = { unit = "rad", derivative = "rate", initial = "angle", initial_std = 1e-3 }
rate = { unit = "rad/s", derivative = "pivot_force / (mass * arm ** 2)", process_noise = 1e-3 }

[inputs.voltage]
unit = "V"
hold = "zero_order"
delays = ["late"]

[outputs.angle]
unit = "rad"
expression = "angle"
noise = 1e-4

[joints.pivot]
coordinate = "angle"
rate = "rate"
inertia = "mass * arm ** 2"
load = '''
    torque
    - pull * sin(angle)'''
force_unit = "N m"
coordinate_unit = "rad"
force_scale = 5.0
coordinate_scale = 0.5
rate_scale = 1
smooth_rate = 1e-3

[actuators.motor]
command = "voltage"
joint = "pivot"
gain = "motor_constant"
rate_unit = "V"

[sensors.encoder]
angle = "angle"
"""

BASED = """\
# The vehicle in the hall.
name = "hall"
base = "monocab_roll"

[parameters]
inertia = { value = 1500, std = 50.0 }   # weighed

# since the bearings were changed
[[effects]]
name = "coulomb_friction"
at = "roll"
[effects.parameters]
torque = { value = 12.5, std = 1.5 }     # N m

# an unbalanced load
[[effects]]
name = "static_torque"

# what was done
[[history]]
action = "add"
effect = "coulomb_friction"
recording = "sweep.arrow"
date = 2026-01-02
error_before = 3.2
error_after = { roll = 1.1 }
who = "me"
"""

BUMP = """
name = "rail_bump"
family = "stiffness"
title = "a dent in the rail head"
place = "joint"
force = "-torque * exp(-(coordinate / width) ** 2)"
[[parameters]]
name = "torque"
unit = "{force}"
meaning = "at the dent"
amplitude = true
scale = "force_scale"
[[parameters]]
name = "width"
unit = "{coordinate}"
meaning = "of the dent"
value = "coordinate_scale / 4"
scale = "coordinate_scale / 20"
"""

REPOSITORY = Path(__file__).resolve().parents[2]
NOW = datetime(2026, 5, 6, 7, 8, 9, tzinfo=UTC)


@pytest.fixture
def based(tmp_path: Path) -> Path:
    path = tmp_path / "mine.toml"
    path.write_text(BASED)
    return path


def test_file_adds_values_effects_and_history_to_a_shipped_model() -> None:
    file = parse(BASED, "x/mine.toml")
    model = file.model
    assert (model.name, model.title) == ("hall", library.get("monocab_roll").title)
    assert (model.parameter("inertia").value, model.parameter("inertia").std) == (1500.0, 50.0)
    assert model.parameter("trim_mass") == library.get("monocab_roll").parameter("trim_mass")
    assert [effect.name for effect in model.effects] == ["coulomb_friction", "static_torque"]
    assert model.values["coulomb_friction.torque"] == 12.5
    assert model.values["static_torque.torque"] == 0.0
    (entry,) = file.history
    assert entry["error_after"] == {"roll": 1.1}
    assert entry["who"] == "me"


def test_file_can_define_its_own_equations() -> None:
    model = parse(OWN, "folder/my pendulum.toml").model
    assert model.name == "my_pendulum"
    assert model.title == "Pendulum on a motor"
    assert [state.name for state in model.states] == ["angle", "rate"]
    assert model.inputs[0].delays == ("late",)
    assert model.outputs[0].noise == 1e-4
    assert model.parameter("arm").estimated is False
    assert math.isinf(model.parameter("mass").upper)
    assert model.add("coulomb_friction").effects[0].at == "pivot"


@pytest.mark.parametrize(
    ("section", "kind"),
    [
        (model_sections.StateSection, State),
        (model_sections.InputSection, Input),
        (model_sections.OutputSection, Output),
        (model_sections.ParameterSection, Parameter),
        (model_sections.JointSection, Joint),
        (model_sections.ActuatorSection, Actuator),
        (model_sections.SensorSection, Sensor),
    ],
)
def test_sections_of_a_file_have_all_fields_of_the_model_parts(section: Any, kind: Any) -> None:
    assert {"name", *section.model_fields} == {each.name for each in dataclasses.fields(kind)}


def test_load_model_accepts_names_and_paths(based: Path) -> None:
    assert load_model("axis") is library.get("axis")
    assert load_model(str(based)).name == load_model(based).name == "hall"
    with pytest.raises(ModelError, match=r"there is no such model.*monocab_roll"):
        load_model("monocab")
    other = based.rename(based.with_suffix(".txt"))
    with pytest.raises(ModelError, match=r"is not a model file.*end in \.toml"):
        load_model(other)


WRONG_OWN = [
    ('title = "Pendulum on a motor"', "title = 3", "title", "is not text (found 3)"),
    ('title = "Pendulum on a motor"', 'titel = "x"', "titel", "did you mean 'title'?"),
    ('title = "Pendulum on a motor"', 'name = "my pendulum"', "name", "should match pattern"),
    ('title = "Pendulum on a motor"', 'base = "axis"', "states", "the base axis has equations already"),
    ("[states]", "[state]", "state", "did you mean 'states'?"),
    ("derivative = \"rate\", ", "", "states.angle.derivative", "is missing"),
    ('derivative = "rate"', 'derivative = ""', "states.angle.derivative", "is empty"),
    ('derivative = "rate"', 'derivative = "rte"', "states.angle.derivative", "did you mean 'rate'?"),
    ('derivative = "rate"', 'derivative = "rate.real"', "states.angle.derivative", "there is no 'rate.real'"),
    ('derivative = "rate"', 'derivative = "lambda: rate"', "states.angle.derivative", "is not allowed in an equation"),
    ('derivative = "rate"', 'derivative = "rate / 0"', "states.angle.derivative", "divides by zero"),
    ('derivative = "rate"', "derivative = 0", "states.angle.derivative", 'write it in quotes: derivative = "0"'),
    ('derivative = "rate"', 'derivatve = "rate"', "states.angle", "derivat"),
    ("initial_std = 1e-3", "initial_std = -1e-3", "states.angle.initial_std", "greater than or equal to 0"),
    ("initial_std = 1e-3", "initial_std = nan", "states.angle.initial_std", "is not a finite number (found nan)"),
    ("initial_std = 1e-3", 'initial_std = "1e-3"', "states.angle.initial_std", "is not a finite number (found '1e-3')"),
    ('initial = "angle"', 'initial = "rate"', "states.angle.initial", "there is no 'rate'"),
    ('initial = "angle"', 'noise_of = "angel"', "states.angle.noise_of", "did you mean 'angle'?"),
    ('initial = "angle"', 'error_of = "angel"', "states.angle.error_of", "did you mean 'angle'?"),
    ("process_noise = 1e-3", "process_noise = inf", "states.rate.process_noise", "is not a finite number (found inf)"),
    ("process_noise = 1e-3", "process_noise = true", "states.rate.process_noise", "(found True)"),
    ("[inputs.voltage]", "[inputs.2volt]", "inputs.2volt", "is not a valid name"),
    ("[inputs.voltage]", "[inputs.time]", "inputs.time", "is predefined in every equation"),
    ("[inputs.voltage]", "[inputs.pi]", "inputs.pi", "is predefined in every equation"),
    ("[inputs.voltage]", "[inputs.sin]", "inputs.sin", "is the name of a function"),
    ("[inputs.voltage]", "[inputs.lambda]", "inputs.lambda", "is a keyword of Python"),
    ("[inputs.voltage]", "[inputs.rate]", "inputs.rate", "is in states already"),
    ("pull =", "angle =", "definitions.angle", "is in states already"),
    ("pull =", "voltage_slope =", "definitions.voltage_slope", "is the slope of input voltage already"),
    ("pull =", "pivot_force =", "definitions.pivot_force", "is the force at joint pivot already"),
    ('pull = "mass', 'pull = "torque * mass', "definitions.pull", "'torque', which is not known here yet"),
    ('pull = "mass', 'pull = "pivot_force + mass', "definitions.pull", "'pivot_force', which is not known here yet"),
    ("pull =", "pull = 3\npulling =", "definitions.pull", "write it in quotes"),
    ('hold = "zero_order"', 'hold = "zero"', "inputs.voltage.hold", "'zero_order' or 'cubic'"),
    ('delays = ["late"]', 'delays = ["lte"]', "inputs.voltage.delays", "did you mean 'late'?"),
    ('delays = ["late"]', 'delays = "late"', "inputs.voltage.delays", "is not a list"),
    ('delays = ["late"]', 'lag = "voltage"', "inputs.voltage.lag", "there is no 'voltage' in parameters"),
    ("noise = 1e-4", "noise = 0.0", "outputs.angle.noise", "greater than 0"),
    ("noise = 1e-4", "", "outputs.angle.noise", "is missing"),
    ("value = 2.0,", "", "parameters.mass.value", "is missing, and there is no base"),
    ('unit = "kg", ', "", "parameters.mass.unit", "is missing, and there is no base"),
    ("value = 2.0,", "value = -2.0,", "parameters.mass.value", "outside its bounds, 0 to inf"),
    ("value = 2.0,", "value = inf,", "parameters.mass.value", "is not a finite number"),
    ("upper = 0.05", "upper = -0.05", "parameters.late", "its bounds cross"),
    ("upper = 0.05", "upper = nan", "parameters.late", "its bounds cross"),
    ("mass = {", "mass = { stdd = 1,", "parameters.mass.stdd", "did you mean 'std'?"),
    ("arm = {", "arm = 0.5\narm_ = {", "parameters.arm", "is not a table (found 0.5)"),
    ("arm = {", "mass = {", "", "not valid TOML"),
    ('command = "voltage"', 'command = "volts"', "actuators.motor.command", "there is no 'volts' in inputs"),
    ('joint = "pivot"', 'joint = ""', "actuators.motor.joint", "use one of: pivot"),
    ('gain = "motor_constant"', 'gain = "torque"', "actuators.motor.gain", "'torque', which is not known here yet"),
    ('[sensors.encoder]\nangle = "angle"', "[sensors.encoder]", "sensors.encoder", "has neither angle nor rate"),
    ('[sensors.encoder]\nangle = "angle"', '[sensors.e]\nrate = "rate"', "sensors.e.rate", "no 'rate' in outputs"),
    ('[sensors.encoder]', '[sensors.encoder]\nactuator = "moto"', "sensors.encoder.actuator", "did you mean 'motor'?"),
    (
        '[sensors.encoder]',
        '[sensors.encoder]\nactuator = "motor"\nangle_unit = "deg"',
        "sensors.encoder.angle_unit",
        "is 'deg', but the joint of its actuator moves in 'rad'",
    ),
    ('joint = "pivot"', 'joint = "pivot"\ninertia = "angle"', "actuators.motor.inertia", "there is no 'angle'"),
    ("smooth_rate = 1e-3", "smooth_rate = 0", "joints.pivot.smooth_rate", "greater than 0"),
    ("smooth_rate = 1e-3", "smoothrate = 1e-3", "joints.pivot", "smooth"),
    ("[joints.pivot]", "[joints.hinge]", "actuators.motor.joint", "use one of: hinge"),
]  # fmt: skip


@pytest.mark.parametrize(("old", "new", "key", "said"), WRONG_OWN, ids=lambda text: str(text)[:30])
def test_error_in_own_equations_names_the_key(old: str, new: str, key: str, said: str) -> None:
    assert old in OWN
    _wrong(OWN.replace(old, new, 1), key, said)


@pytest.mark.parametrize(
    ("old", "new", "key", "said"),
    [
        ('base = "monocab_roll"', 'base = "monocab_rol"', "base", "did you mean 'monocab_roll'?"),
        ('base = "monocab_roll"', "", "base", "is missing, and there are no equations either"),
        ('base = "monocab_roll"', "base = 3", "base", "is not text (found 3)"),
        ("inertia = {", "inertai = {", "parameters.inertai", "did you mean 'inertia'?"),
        ("value = 1500,", "value = -1500,", "parameters.inertia.value", "outside its bounds"),
        ("value = 1500,", 'value = 1500, unit = "g m^2",', "parameters.inertia.unit", "give the value in 'kg m^2'"),
        ("value = 1500,", "value = 1500, lower = 2e3, upper = 1e3,", "parameters.inertia", "its bounds cross"),
        ("value = 1500,", "vale = 1500,", "parameters.inertia.vale", "did you mean 'value'?"),
        ("std = 50.0", "std = -50.0", "parameters.inertia.std", "greater than or equal to 0"),
        ('name = "coulomb_friction"', 'name = "coulomb_frction"', "effects.0", "did you mean coulomb_friction"),
        ('name = "coulomb_friction"', 'nam = "coulomb_friction"', "effects.0.nam", "did you mean 'name'?"),
        ('name = "coulomb_friction"', "", "effects.0", "has neither name nor file"),
        ('at = "roll"', 'at = "rol"', "effects.0", "there is no joint 'rol'"),
        ('at = "roll"', 'at = "roll"\nfile = "no.toml"', "effects.0", "cannot be read"),
        ("torque = {", "troque = {", "effects.0.parameters.troque", "did you mean 'torque'?"),
        ("value = 12.5", "value = -12.5", "effects.0.parameters.torque.value", "outside its bounds"),
        ("value = 12.5", "value = nan", "effects.0.parameters.torque.value", "is not a finite number"),
        ('name = "static_torque"', 'name = "coulomb_friction"', "effects.1", "has it already"),
        ('action = "add"\n', "", "history.0.action", "is missing"),
        ("error_before", "error_befor", "history.0.error_befor", "write 'error_before'"),
        ("error_before = 3.2", "error_before = inf", "history.0.error_before", "finite"),
        ("[[history]]", "[history]", "history", "is not a list"),
    ],
)  # fmt: skip
def test_error_in_the_values_of_a_shipped_model_names_the_key(old: str, new: str, key: str, said: str) -> None:
    assert old in BASED
    _wrong(BASED.replace(old, new, 1), key, said)


def _wrong(text: str, key: str, said: str) -> None:
    with pytest.raises(ModelError) as caught:
        parse(text, "mine.toml")
    assert caught.value.where.startswith(f"mine.toml: {key}" if key else "mine.toml")
    assert said in str(caught.value)
    assert caught.value.remedy


def test_effect_needs_a_suitable_place_in_the_model() -> None:
    without = OWN[: OWN.index("[joints.pivot]")].replace("pivot_force", "torque")
    parse(without, "mine.toml")
    _wrong(f'{without}\n[[effects]]\nname = "coulomb_friction"', "effects.0", "needs a joint, but the model has none")
    _wrong(f'{OWN}\n[[effects]]\nname = "gimbal_imbalance"', "effects.0", "actuator_angle")


@pytest.mark.parametrize("key", ["states", "outputs"])
def test_model_needs_states_and_outputs(key: str) -> None:
    table = tomllib.loads(OWN)
    del table[key]
    with pytest.raises(ModelError, match=f"{key}: there are none"):
        parse(_as_toml(table), "mine.toml")


def _as_toml(table: Mapping[str, Any]) -> str:
    import tomlkit

    return tomlkit.dumps(table)


def test_exponentially_growing_definitions_are_refused() -> None:
    bombs = '\nd0 = "mass"\n' + "\n".join(f'd{i + 1} = "d{i} * d{i} * d{i}"' for i in range(60))
    _wrong(
        OWN.replace("[definitions]", f"[definitions]{bombs}"),
        "definitions.d9",
        "terms with the definitions substituted",
    )


def test_unused_input_is_allowed() -> None:
    assert len(parse(f'{OWN}\n[inputs.temperature]\nunit = "K"', "mine.toml").model.inputs) == 2


def test_unreadable_files_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ModelError, match=r"nowhere\.toml: cannot be read: No such file.*axis"):
        read(tmp_path / "nowhere.toml")
    (tmp_path / "latin.toml").write_bytes("title = 'Größe'".encode("latin-1"))
    with pytest.raises(ModelError, match="UTF-8"):
        read(tmp_path / "latin.toml")
    with pytest.raises(ModelError, match=r"not valid TOML.*line 2"):
        parse("base = 'axis'\nx = = 3", tmp_path / "mine.toml")
    with pytest.raises(ModelError, match="not valid TOML"):
        parse("x = " + "[" * 5000, tmp_path / "mine.toml")


# Writing


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


# Rendering


@pytest.fixture(scope="module")
def crowded() -> Model:
    """A model with effects at every kind of place, also with states, and one that uses the load."""
    model = parse(OWN, "mine.toml").model
    for effect in (
        "flexible_mode", "static_torque", "coulomb_friction", "hysteresis", "cubic_stiffness",
        "input_gain", "input_deadband", "input_delay", "sensor_offset",
    ):  # fmt: skip
        model = model.add(effect)
    return model


def test_rendered_lines_compute_the_same_values_as_the_composed_equations(crowded: Model) -> None:
    from upright.models.compiler.equations import Magnitude, Signum, compose

    draw = random.Random(2)
    names = [each.name for each in (*crowded.states, *crowded.inputs, *crowded.parameters)]
    start = {"time": 0.7, "voltage_slope": 0.3, **{name: draw.uniform(0.1, 2.0) for name in names}}
    known, slopes, shown = {name.replace("@", "_at_"): value for name, value in start.items()}, {}, {}
    for line in rendering.equations(crowded):
        if line.kind in (rendering.Kind.DELAY, rendering.Kind.LAG):
            continue
        value = number(line.expression, known | {f"{name}_measured": value for name, value in shown.items()})
        target = {"derivative": slopes, "output": shown, "reading": shown}.get(line.kind, known)
        target[line.name] = value

    composed = compose(crowded)
    exact = {sympy.Symbol(name, real=True): value for name, value in start.items()}
    for parts, symbols, found in (
        (composed.derivatives, crowded.states, slopes),
        (composed.outputs, crowded.outputs, shown),
    ):
        for expression, part in zip(parts, symbols, strict=True):
            plain = expression.replace(Signum, sympy.sign).replace(Magnitude, sympy.Abs)
            assert found[part.name] == pytest.approx(float(plain.subs(exact)), rel=1e-9), part.name
    (delay,) = (line for line in rendering.equations(crowded) if line.kind is rendering.Kind.DELAY)
    assert delay.expression == " + ".join(composed.delays[0])


def test_sensors_on_an_actuator_include_the_backlash_twist() -> None:
    from upright.models.compiler.equations import compose

    robot = library.get("twsbr").add("backlash")
    composed = compose(robot)
    width, place, speed = (sympy.Symbol(f"backlash.{name}", real=True) for name in ("width", "place", "speed"))
    shown = {output.name: expression for output, expression in zip(robot.outputs, composed.outputs, strict=True)}
    for side in ("left", "right"):
        for output, ahead in ((f"{side}_wheel_angle", place), (f"{side}_wheel_rate", speed)):
            assert sympy.simplify(shown[output] - sympy.Symbol(output, real=True) - 0.5 * width * ahead) == 0
    assert {width, place} & shown["tilt_rate"].free_symbols == set()

    text = _squeezed(rendering.text(robot))
    assert "backlash_twist = 0.5 * backlash.width * backlash.place" in text
    assert "left_wheel_angle_measured := left_wheel_angle_measured + backlash_twist [backlash]" in text
    assert "right_wheel_rate_measured := right_wheel_rate_measured + backlash_twist' [backlash]" in text
    assert r"\dot{\mathrm{backlash}_{\mathrm{twist}}}" in rendering.latex(robot)


def test_sensors_without_an_actuator_omit_the_twist_and_change_the_fingerprint() -> None:
    robot = library.get("twsbr").add("backlash")
    loose = dataclasses.replace(robot, sensors=tuple(dataclasses.replace(each, actuator="") for each in robot.sensors))
    assert "backlash_twist" not in rendering.text(loose)
    assert fingerprint(loose) != fingerprint(robot)


def test_rendered_text_names_each_effect(crowded: Model) -> None:
    text = _squeezed(rendering.text(crowded))
    assert "pivot_force = pivot_load + static_torque + coulomb_friction" in text
    assert "coulomb_friction = -coulomb_friction.torque * tanh(rate / 0.001)" in text
    assert "pivot_load = torque - pull * sin(angle)" in text
    assert "voltage := voltage * (1 + input_gain.gain) [input_gain]" in text
    assert "angle_measured := angle_measured + sensor_offset.offset [sensor_offset]" in text
    assert "voltage is delayed by late + input_delay.delay" in text


def _squeezed(text: str) -> str:
    return re.sub(" +", " ", text)


def test_model_without_effects_is_rendered_as_written() -> None:
    assert rendering.text(library.get("axis")).splitlines() == [
        "axis_force        = force_gain * force",
        "position'         = rate",
        "rate'             = axis_force / inertia",
        "position_measured = position",
    ]


def test_effect_at_a_second_place_is_rendered_with_its_place(crowded: Model) -> None:
    second = dataclasses.replace(crowded.joints[0], name="elbow", load="0")
    model = dataclasses.replace(crowded, joints=(*crowded.joints, second)).add("coulomb_friction", "elbow")
    line = "coulomb_friction@elbow = -coulomb_friction@elbow.torque * tanh(rate / 0.001)"
    assert line in _squeezed(rendering.text(model))
    assert r"\mathrm{torque}_{\mathrm{coulomb\,friction\,at\,elbow}}" in rendering.latex(model)


def test_latex_is_well_formed(crowded: Model) -> None:
    latex = rendering.latex(crowded)
    assert latex.startswith("\\begin{align*}\n")
    assert latex.endswith("\n\\end{align*}")
    assert r"\dot{\mathrm{rate}} &= \frac{\mathrm{pivot}_{\mathrm{force}}}" in latex
    assert r"\dot{z_{\mathrm{hysteresis}}} &=" in latex
    assert "_at_" not in latex
    depth = 0
    for bracket in latex.replace(r"\{", "").replace(r"\}", ""):
        depth += {"{": 1, "}": -1}.get(bracket, 0)
        assert depth >= 0
    assert depth == 0
    assert latex.count(r"\left(") == latex.count(r"\right)")


def test_delayed_sensor_is_rendered_with_time_derivatives() -> None:
    late = library.get("monocab_reduced").add("sensor_delay")
    assert r"\ddot{\mathrm{roll}_{\mathrm{measured}}}" in rendering.latex(late)
    assert "roll_measured''" in rendering.text(late)


# The command line


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


# The manual


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


@pytest.mark.parametrize("section", model_sections.Section.__subclasses__(), ids=lambda section: section.__name__)
def test_every_key_of_a_model_file_is_documented(section: Any) -> None:
    page = (REPOSITORY / "docs" / "reference" / "model-file.md").read_text()
    keys = set(section.model_fields)
    assert keys
    assert not sorted(key for key in keys if not re.search(rf"`{key}`|`\[+{key}\b", page))


class TestDisturbance:
    """`[joints.NAME.disturbance]` in a file with a base."""

    BASED = 'base = "monocab_roll"\n'

    @pytest.mark.parametrize(
        ("text", "stated"),
        [
            ("", Disturbance()),
            ("[joints.roll]\ndisturbance = false\n", None),
            ("[joints.roll.disturbance]\nstd = 8.0\ncorrelation_time = 0.3\n", Disturbance(8.0, 0.3)),
            (
                "[joints.roll.disturbance]\nstd = 8.0\ncorrelation_time = 0.3\nknown = true\n",
                Disturbance(8.0, 0.3, known=True),
            ),
            (
                "[joints.roll.disturbance]\nshortest = 0.1\nlongest = 2.0\n",
                Disturbance(shortest=0.1, longest=2.0),
            ),
        ],
    )
    def test_stated_disturbance_is_read_and_survives_writing(
        self, tmp_path: Path, text: str, stated: Disturbance | None
    ) -> None:
        path = tmp_path / "mine.toml"
        file = parse(self.BASED + text, path)
        assert file.model.joints[0].disturbance == stated
        write(file, path)
        assert read(path) == file
        write(replace(file, model=file.model.change({"inertia": 1500.0})), path)
        assert read(path).model.joints[0].disturbance == stated
        assert 'base = "monocab_roll"' in path.read_text()

    @pytest.mark.parametrize(
        ("text", "said"),
        [
            ("[joints.rol]\ndisturbance = false\n", "did you mean 'roll'"),
            ('[joints.roll]\nload = "0"\n', "states only the disturbance of a joint"),
            ("[joints.roll.disturbance]\nrms = 8.0\n", "is not a key"),
            ("[joints.roll.disturbance]\nstd = -1.0\n", "joints.roll.disturbance"),
            ("[joints.roll.disturbance]\nknown = true\n", "give both"),
            ("[joints.roll.disturbance]\nshortest = 2.0\nlongest = 1.0\n", "bounds cross"),
            ("[joints.roll.disturbance]\ncorrelation_time = 3.0\nlongest = 1.0\n", "outside its bounds"),
        ],
    )
    def test_invalid_disturbance_is_refused(self, tmp_path: Path, text: str, said: str) -> None:
        with pytest.raises(ModelError, match=said):
            parse(self.BASED + text, tmp_path / "mine.toml")
