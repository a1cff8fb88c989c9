"""A table of a balancing robot from another simulator: its tilt is measured directly, so no filter takes acceleration
for tilt. Diagnosed by `upright diagnose TABLE --vehicle twsbr`, with a few effects to look for."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from benchmarks.others_robot import EFFECTS, OthersRobot, hill
from upright.estimators.data.as_recorded import as_recorded
from upright.models.library import get
from upright.service.cli import app
from upright.service.cli.inputs import load_recording
from upright.service.virtual.run import record

pytestmark = pytest.mark.patient

LOOKED_FOR = ("static_torque", "sensor_scale", "input_deadband")
WITHIN = 3.0
"""Standard deviations by which an estimate may be off."""


def diagnosed(path: Path) -> Any:
    names = [word for name in LOOKED_FOR for word in ("--effect", name)]
    arguments = ["diagnose", str(path), "--vehicle", "twsbr", *names, "--budget", "inf", "--json"]
    done = CliRunner().invoke(app, arguments, catch_exceptions=False)
    assert done.exit_code == 0, done.output
    return json.loads(done.stdout)


def test_correct_model_is_adequate(tmp_path: Path) -> None:
    """With the tilt filter in the model, a scale error of the gyro of 1.3 % was found."""
    found = diagnosed(OthersRobot(seed=41).write(tmp_path / "theirs.csv"))
    assert found["verdict"] == "adequate", found["reason"]


@pytest.mark.parametrize(
    ("effect", "parameter", "size"),
    [("static_torque@travel", "torque", hill(2.0)), ("input_deadband", "width", 0.6)],
)
def test_missing_effect_is_found_with_its_amplitude(effect: str, parameter: str, size: float, tmp_path: Path) -> None:
    found = diagnosed(OthersRobot(seed=42, **EFFECTS[effect]).write(tmp_path / "theirs.csv"))
    assert found["verdict"] == "missing_effect", found["reason"]
    (named,) = found["findings"]
    assert named["effect"] == effect
    estimate = named["parameters"][f"{effect}.{parameter}"]
    assert abs(estimate["value"] - size) < WITHIN * estimate["std"]


def test_filter_errors_decay_in_the_model_of_a_directly_measured_tilt(tmp_path: Path) -> None:
    """The white noise of the tilt shows whether a filter computed it."""
    model = get("twsbr")
    theirs = load_recording(OthersRobot(seed=43).write(tmp_path / "theirs.csv"), "twsbr")
    errors = {each.name for each in model.base_states if each.error_of == "tilt"}
    derivatives = {each.name: each.derivative for each in as_recorded(model, [theirs]).base_states}
    assert errors == {"tilt_error", "level_error", "rate_error"}
    assert all(derivatives[name] == f"-{name}" for name in errors)
    assert derivatives["tilt"] == "tilt_rate"
    ours = record("twsbr", "square", seed=43, duration=8.0)
    assert as_recorded(model, [ours]).base_states == model.base_states
