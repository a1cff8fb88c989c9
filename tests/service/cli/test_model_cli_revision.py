"""`upright model add` with recordings, `undo` and `drop-test`: what is written and undone, always completely."""

from __future__ import annotations

import json
import math
import tomllib
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from upright.models.file.history import before_fits, undone
from upright.models.file.model_file import read
from upright.models.parts import ModelError
from upright.service import cli
from upright.telemetry.channels import Channel, ChannelTable
from upright.telemetry.errors import UprightError
from upright.telemetry.recording import Recording
from upright.telemetry.storage import load, save

CHANNELS = ChannelTable((Channel("position", "m", ""), Channel("force", "N", "")))
COULOMB, VISCOUS, MASS = 4.0, 3.0, 2.0

MODEL = """\
# My carriage.

[parameters]
inertia = { unit = "kg", value = 1.8, std = 0.3 }  # weighed on a bathroom scale

[states]
position = { unit = "m", derivative = "rate", initial = "position", initial_std = 1e-3 }
rate = { unit = "m/s", derivative = "axis_force / inertia", initial_std = 0.1, process_noise = 1e-3 }

[inputs.force]
unit = "N"
hold = "zero_order"

[outputs.position]
unit = "m"
expression = "position"
noise = 5e-4

[joints.axis]
coordinate = "position"
rate = "rate"
inertia = "inertia"
load = "force"
force_unit = "N"
coordinate_unit = "m"
force_scale = 10.0
coordinate_scale = 0.1
rate_scale = 0.1
smooth_rate = 1e-2

[actuators.drive]
command = "force"
joint = "axis"
rate_unit = "N"
command_scale = 10.0

[[effects]]
name = "viscous_friction"

[effects.parameters]
coefficient = { value = 0.0, std = 0.0 }
"""


def carriage(path: Path, seed: int) -> Path:
    """12 s of a multisine at 100 Hz on a carriage with dry friction, written as CSV; half a millimetre of noise."""
    rows, steps, spacing = 1200, 20, 0.01
    time = spacing * np.arange(rows)
    phases = np.random.default_rng(seed).uniform(0.0, 2.0 * np.pi, 4)
    force = 5.0 * sum(np.sin(2.0 * np.pi * f * time + p) for f, p in zip((0.3, 0.5, 0.8, 1.3), phases, strict=True))
    position, rate, track, step = 0.0, 0.0, [], spacing / steps

    def acceleration(rate: float, pushed: float) -> float:
        return (pushed - VISCOUS * rate - COULOMB * math.tanh(rate / 1e-2)) / MASS

    for pushed in force:
        track.append(position)
        for _ in range(steps):
            middle = rate + 0.5 * step * acceleration(rate, pushed)
            position += step * middle
            rate += step * acceleration(middle, pushed)
    measured = np.array(track) + 5e-4 * np.random.default_rng(seed + 1).standard_normal(rows)
    stamps = np.round(time * 1e9).astype(np.int64)
    save(Recording(CHANNELS, stamps, {"position": measured, "force": force}), path)
    return path


def upright(*arguments: object) -> str:
    done = CliRunner().invoke(cli.app, ["model", *map(str, arguments)])
    if done.exception is not None and not isinstance(done.exception, SystemExit):
        raise done.exception
    assert done.exit_code == 0, done.output
    return done.stdout


@pytest.fixture(scope="module")
def recordings(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    folder = tmp_path_factory.mktemp("carriage")
    return carriage(folder / "first.csv", 1), carriage(folder / "second.csv", 11)


@pytest.fixture(scope="module")
def added(tmp_path_factory: pytest.TempPathFactory, recordings: tuple[Path, Path]) -> tuple[str, dict[str, Any], bytes]:
    """The file after `add`, the output of `--json`, and the first bytes of the picture."""
    folder = tmp_path_factory.mktemp("added")
    (folder / "mine.toml").write_text(MODEL)
    first, second = recordings
    answer = upright(
        "add", folder / "mine.toml", "coulomb_friction", "--recording", first, "--held-out", second,
        "--picture", folder / "repair.png", "--json",
    )  # fmt: skip
    return (folder / "mine.toml").read_text(), json.loads(answer), (folder / "repair.png").read_bytes()[:8]


@pytest.fixture
def mine(tmp_path: Path, added: tuple[str, dict[str, Any], bytes]) -> Path:
    """The model file with the fitted effect."""
    path = tmp_path / "mine.toml"
    path.write_text(added[0])
    return path


def test_fitted_values_and_their_deviations_are_written(mine: Path) -> None:
    model = read(mine).model
    for name, truth in {
        "inertia": MASS,
        "viscous_friction.coefficient": VISCOUS,
        "coulomb_friction.torque": COULOMB,
    }.items():
        parameter = model.parameter(name)
        assert 0.0 < parameter.std < 0.05 * truth, name
        assert abs(parameter.value - truth) < 4.0 * parameter.std + 0.01 * truth, name
    text = mine.read_text()
    assert text.startswith("# My carriage.\n")
    assert "# weighed on a bathroom scale" in text
    inertia = tomllib.loads(text)["parameters"]["inertia"]
    assert max(len(repr(inertia[key])) for key in ("value", "std")) < 12, "no digits that mean nothing"


def test_history_records_errors_values_and_hashes_of_the_recordings(mine: Path, recordings: tuple[Path, Path]) -> None:
    (entry,) = tomllib.loads(mine.read_text())["history"]
    assert (entry["action"], entry["effect"]) == ("add", "coulomb_friction")
    assert entry["recording"] == ["first.csv"]
    assert entry["held_out"] == ["second.csv"]
    assert entry["sha256"] == [sha256(recordings[0].read_bytes()).hexdigest()]
    assert entry["held_out_sha256"] == [sha256(recordings[1].read_bytes()).hexdigest()]
    assert entry["held_out_error_after"]["position"] < 0.5 * entry["held_out_error_before"]["position"]
    assert entry["error_after"]["position"] < 0.5 * entry["error_before"]["position"]
    assert entry["values_before"]["inertia"] == {"value": 1.8, "std": 0.3}
    assert entry["values_after"]["inertia"]["value"] == read(mine).model.values["inertia"]
    shown = upright("show", mine)
    assert "held_out_error_after" in shown
    assert "sha256" not in shown


def test_json_output_has_the_whole_revision(added: tuple[str, dict[str, Any], bytes]) -> None:
    _, document, picture = added
    revision = document["repair"]
    assert document["effect"] == revision["effect"] == "coulomb_friction"
    assert revision["needed"]
    assert sum(revision["budget"].values()) == pytest.approx(1.0)
    left = [revision[when]["disturbance"]["axis"]["rms"] for when in ("before", "after")]
    assert left[0] > left[1]
    assert revision["after"]["held_out"]["position"][-1] < revision["before"]["held_out"]["position"][-1]
    assert "the held-out error 1.25 s ahead falls by" in revision["words"][0]
    assert picture == b"\x89PNG\r\n\x1a\n"


def test_undo_restores_the_file(mine: Path) -> None:
    answer = json.loads(upright("undo", mine, "--json"))
    assert answer == {"file": str(mine), "removed": "coulomb_friction", "effects": ["viscous_friction"], "kept": []}
    assert tomllib.loads(mine.read_text()) == {
        **tomllib.loads(MODEL),
        "effects": [{"name": "viscous_friction", "parameters": {"coefficient": {"value": 0.0, "std": 0.0}}}],
    }
    assert "# weighed on a bathroom scale" in mine.read_text()
    with pytest.raises(ModelError, match="nothing to undo"):
        upright("undo", mine)


def test_undo_keeps_values_that_were_changed_by_hand_since(mine: Path) -> None:
    value = read(mine).model.values["inertia"]
    mine.write_text(mine.read_text().replace(f"value = {value}", "value = 2.125", 1))
    assert read(mine).model.values["inertia"] == 2.125
    assert "kept: inertia" in upright("undo", mine)
    model = read(mine).model
    assert model.values["inertia"] == 2.125
    assert model.values["viscous_friction.coefficient"] == 0.0


def test_undo_is_refused_if_the_last_change_is_not_an_addition(mine: Path) -> None:
    upright("remove", mine, "viscous_friction")
    before = mine.read_bytes()
    with pytest.raises(ModelError, match="only 'add' can be undone"):
        upright("undo", mine)
    assert mine.read_bytes() == before


def test_next_fit_starts_from_the_values_before_any_fit(mine: Path) -> None:
    """A fitted value with its deviation as prior would count the same recording twice."""
    model = before_fits(read(mine))
    assert (model.values["inertia"], model.parameter("inertia").std) == (1.8, 0.3)
    torque = model.parameter("coulomb_friction.torque")
    assert torque.std == 0.0
    assert torque.value == read(mine).model.values["coulomb_friction.torque"]
    mine.write_text(mine.read_text().replace("std = ", "std = 9", 1))
    assert before_fits(read(mine)).values["inertia"] == read(mine).model.values["inertia"], "set by hand since"


def test_additions_are_undone_one_by_one(mine: Path, recordings: tuple[Path, Path]) -> None:
    first = undone(read(mine))[0]
    after_one = tomllib.loads(mine.read_text())
    upright("add", mine, "input_asymmetry", "-r", recordings[0], "--held-out", recordings[1], "--json")
    two = read(mine)
    assert [entry["effect"] for entry in two.history] == ["coulomb_friction", "input_asymmetry"]
    assert two.history[1]["values_before"]["inertia"] == after_one["history"][0]["values_after"]["inertia"]
    # Same recording, same prior: adding an effect that the plant does not have hardly changes the other values.
    assert two.model.values["inertia"] == pytest.approx(after_one["parameters"]["inertia"]["value"], rel=2e-3)
    assert two.model.parameter("inertia").std == pytest.approx(after_one["parameters"]["inertia"]["std"], rel=0.2)
    upright("undo", mine)
    assert tomllib.loads(mine.read_text())["history"] == after_one["history"]
    assert tomllib.loads(mine.read_text())["parameters"] == after_one["parameters"]
    upright("undo", mine)
    assert read(mine).model == first.model


def test_file_without_history_can_be_tested_but_not_undone(tmp_path: Path, recordings: tuple[Path, Path]) -> None:
    mine = tmp_path / "mine.toml"
    mine.write_text(MODEL + '\n[[effects]]\nname = "coulomb_friction"\n')
    page = upright("drop-test", mine, recordings[0])
    assert "coulomb_friction" in page
    assert before_fits(read(mine)) == read(mine).model
    with pytest.raises(ModelError, match="upright model remove"):
        upright("undo", mine)


def test_drop_test_separates_needed_effects_from_unnecessary_ones(mine: Path, recordings: tuple[Path, Path]) -> None:
    upright("add", mine, "static_torque")
    before = mine.read_bytes()
    document = json.loads(upright("drop-test", mine, *recordings, "--json"))
    assert {each["effect"]: each["verdict"] for each in document["effects"]} == {
        "static_torque": "can go", "viscous_friction": "needed", "coulomb_friction": "needed",
    }  # fmt: skip
    assert mine.read_bytes() == before
    assert "upright model remove" in upright("drop-test", mine, *recordings)


def test_text_output_has_the_budget_as_a_chart_and_in_words(tmp_path: Path, recordings: tuple[Path, Path]) -> None:
    mine = tmp_path / "mine.toml"
    mine.write_text(MODEL)
    page = upright("add", mine, "coulomb_friction", "-r", recordings[0])
    assert "last third of first.csv" in page
    assert "position, mm" in page
    assert "█" in page
    assert "Disturbance before: " in page
    assert "Disturbance after: " in page
    assert "the held-out error 1.25 s ahead falls by" in page
    assert "upright model undo" in page


@pytest.mark.parametrize(
    ("columns", "said"),
    [
        ({"position": "place"}, "position"),
        ({"force": "push"}, "force"),
    ],
)
def test_unusable_recording_leaves_the_file_unchanged(
    tmp_path: Path, recordings: tuple[Path, Path], columns: dict[str, str], said: str
) -> None:
    mine, bad = tmp_path / "mine.toml", tmp_path / "bad.csv"
    mine.write_text(MODEL)
    header, rest = recordings[0].read_text().split("\n", 1)
    for name, other in columns.items():
        header = header.replace(name, other)
    bad.write_text(f"{header}\n{rest}")
    with pytest.raises(UprightError, match=said) as error:
        upright("add", mine, "coulomb_friction", "-r", bad)
    assert error.value.remedy
    assert mine.read_text() == MODEL
    assert sorted(path.name for path in tmp_path.iterdir()) == ["bad.csv", "mine.toml"]


def test_unusable_held_out_recording_leaves_the_file_unchanged(tmp_path: Path, recordings: tuple[Path, Path]) -> None:
    mine, stuck = tmp_path / "mine.toml", tmp_path / "stuck.csv"
    mine.write_text(MODEL)
    whole = load(recordings[0])
    save(Recording(CHANNELS, whole.timestamp_ns, {**whole.values, "position": np.zeros(len(whole))}), stuck)
    with pytest.raises(UprightError, match="never moves"):
        upright("add", mine, "coulomb_friction", "-r", recordings[0], "--held-out", stuck)
    assert mine.read_text() == MODEL


def test_shipped_model_can_only_be_extended_in_a_new_toml_file(tmp_path: Path) -> None:
    with pytest.raises(ModelError, match="is not changed"):
        upright("add", "monocab_roll", "coulomb_friction")
    target = tmp_path / "mine.toml"
    upright("add", "monocab_roll", "coulomb_friction", "-v", "monocab", "-o", target)
    model = read(target).model
    assert [each.name for each in model.effects] == ["coulomb_friction"]
    with pytest.raises(ModelError, match="already exists"):
        upright("add", "monocab_roll", "coulomb_friction", "-o", target)
    with pytest.raises(ModelError, match=r"use the suffix \.toml"):
        upright("add", "monocab_roll", "coulomb_friction", "-o", tmp_path / "mine.txt")


def test_path_of_a_user_defined_effect_is_adapted_to_the_new_file(tmp_path: Path) -> None:
    (tmp_path / "old").mkdir()
    (tmp_path / "new").mkdir()
    (tmp_path / "old" / "bump.toml").write_text(
        'name = "bump"\nfamily = "stiffness"\ntitle = "a bump"\nplace = "joint"\n'
        'force = "-torque * exp(-(coordinate / coordinate) ** 2)"\n'
        '[[parameters]]\nname = "torque"\nunit = "{force}"\nmeaning = "size"\namplitude = true\nscale = "force_scale"\n'
    )
    (tmp_path / "old" / "mine.toml").write_text('base = "axis"\n[[effects]]\nname = "bump"\nfile = "bump.toml"\n')
    upright("add", tmp_path / "old" / "mine.toml", "coulomb_friction", "-o", tmp_path / "new" / "mine.toml")
    file = read(tmp_path / "new" / "mine.toml")
    assert [each.name for each in file.model.effects] == ["bump", "coulomb_friction"]
    assert file.effect_files == {"bump": "../old/bump.toml"}


def test_python_effect_is_added_once_allowed_and_its_hash_is_in_the_history(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    model, effect = tmp_path / "mine.toml", tmp_path / "wind.py"
    model.write_text('base = "axis"\n')
    effect.write_text(
        "from upright.models.effect import Effect, EffectParameter, Family\nfrom models.parts import Place\n"
        'EFFECT = Effect(name="wind", family=Family.BIAS, title="gusts", place=Place.JOINT, equation="F = torque",\n'
        '    parameters=(EffectParameter("torque", "{force}", "wind", amplitude=True, scale="force_scale"),),\n'
        '    signature="", confused_with=(), separated_by="", force="torque * sin(time) ** 2")\n'
    )
    with pytest.raises(ModelError, match="upright model allow"):
        upright("add", model, effect)
    upright("allow", effect)
    upright("add", model, effect)
    digest = sha256(effect.read_bytes()).hexdigest()
    assert [entry["effect_sha256"] for entry in read(model).history] == [digest]


def test_held_out_without_a_recording_is_a_usage_error(tmp_path: Path) -> None:
    (tmp_path / "mine.toml").write_text(MODEL)
    done = CliRunner().invoke(
        cli.app, ["model", "add", str(tmp_path / "mine.toml"), "coulomb_friction", "--held-out", "x.csv"]
    )
    assert done.exit_code == 2
