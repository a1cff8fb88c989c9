"""Model files that are read: all sections arrive in the model, and errors name the key and a remedy."""

from __future__ import annotations

import dataclasses
import math
import re
import tomllib
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from model_files import BASED, OWN, write_based

from upright.models import library
from upright.models.file import sections as model_sections
from upright.models.file.model_file import load_model, parse, read, write
from upright.models.parts import (
    Actuator,
    Disturbance,
    Input,
    Joint,
    ModelError,
    Output,
    Parameter,
    Sensor,
    State,
)

REPOSITORY = Path(__file__).resolve().parents[2]


@pytest.fixture
def based(tmp_path: Path) -> Path:
    return write_based(tmp_path)


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
