"""A user's own machine: missing effects are found with a model file of the manual and a table, without a vehicle file.

The amplitudes are those of a test bench: friction of a bearing, a buffer, a load that creeps. They are many times the
minimum detectable ones, so that the error of the model's formula is far above the noise, too.
"""

from __future__ import annotations

import json
import math
import re
from pathlib import Path
from typing import Any

import pendulum_plant
import pytest
from thorough import of_many
from typer.testing import CliRunner

from upright.service.cli import app

MANUAL = Path(__file__).resolve().parents[3] / "docs" / "how-to" / "write-your-own-model.md"
SEED = 71
"""No decision was based on it."""
MISSING: dict[str, tuple[pendulum_plant.Missing, dict[str, float]]] = {
    # Smoothed differently from the model's.
    "coulomb_friction": (lambda t, angle, rate: -0.25 * rate / math.hypot(rate, 2e-3), {"torque": 0.25}),
    "viscous_friction": (lambda t, angle, rate: -0.25 * rate, {"coefficient": 0.25}),
    "quadratic_drag": (lambda t, angle, rate: -0.2 * rate * abs(rate), {"coefficient": 0.2}),
    "cubic_stiffness": (lambda t, angle, rate: -8.0 * angle**3, {"coefficient": 8.0}),
    "end_stop": (
        lambda t, angle, rate: -30.0 * math.copysign(max(abs(angle) - 0.35, 0.0), angle),
        {"stiffness": 30.0, "gap": 0.35},
    ),
    "periodic_disturbance": (lambda t, angle, rate: 0.15 * math.sin(2.0 * math.pi * 2.7 * t + 0.3), {"frequency": 2.7}),
    "torque_step": (lambda t, angle, rate: 0.4 if t > 14.0 else 0.0, {"torque": 0.4}),
    # It does not end: its final value is arbitrary.
    "torque_drift": (lambda t, angle, rate: t / 60.0, {}),
}
UNLISTED: dict[str, pendulum_plant.Missing] = {
    "cubic drag": lambda t, angle, rate: -0.25 * rate**3,
    "damping on one side": lambda t, angle, rate: -0.4 * max(rate, 0.0),
}

pytestmark = [pytest.mark.timeout(400), pytest.mark.patient]  # a diagnosis has 300 s


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The first model file of the manual."""
    path = tmp_path_factory.mktemp("own") / "pendulum.toml"
    blocks = re.findall(r"^```toml\n(.*?)^```", MANUAL.read_text(), re.DOTALL | re.MULTILINE)
    path.write_text(blocks[0])
    return path


def upright(*arguments: Any) -> Any:
    done = CliRunner().invoke(app, [*map(str, arguments), "--json"], catch_exceptions=False)
    assert done.exit_code == 0, done.output
    return json.loads(done.stdout)


def diagnosed(
    model: Path, folder: Path, missing: pendulum_plant.Missing = pendulum_plant.nothing, **more: float
) -> Any:
    run = pendulum_plant.write(folder / "run.csv", missing, seed=SEED, **more)
    return upright("diagnose", run, "--model", model, "--budget", 300)  # whatever else the machine has to do


@pytest.mark.parametrize("effect", of_many(MISSING, "torque_step"))
def test_missing_effect_is_found_with_its_parameters(effect: str, model: Path, tmp_path: Path) -> None:
    missing, sizes = MISSING[effect]
    found = diagnosed(model, tmp_path, missing)
    assert found["verdict"] == "missing_effect", found["reason"]
    (named,) = found["findings"]
    assert named["effect"] == effect
    for name, size in sizes.items():
        # To 1 %: on records as rich as these the intervals are narrower than the difference between the integrators.
        assert named["parameters"][f"{effect}.{name}"]["value"] == pytest.approx(size, rel=0.01)


def test_dead_band_of_the_motor_is_found_with_its_width(model: Path, tmp_path: Path) -> None:
    (named,) = diagnosed(model, tmp_path, dead_band=0.6)["findings"]
    assert named["effect"] == "input_deadband"
    assert named["parameters"]["input_deadband.width"]["value"] == pytest.approx(0.6, rel=0.01)


def test_sensor_delay_is_found_and_tied_with_an_input_delay(model: Path, tmp_path: Path) -> None:
    (named,) = diagnosed(model, tmp_path, late=0.011)["findings"]
    assert {named["effect"], *named["tied_with"]} == {"sensor_delay", "input_delay"}
    assert named["parameters"][f"{named['effect']}.delay"]["value"] == pytest.approx(0.011, rel=0.01)


@pytest.mark.parametrize("early", of_many([0.00025, 0.005], 0.005))
def test_early_command_is_not_reported_as_an_effect(early: float, model: Path, tmp_path: Path) -> None:
    """By a twentieth of a sampling step, and by a whole one."""
    assert diagnosed(model, tmp_path, early=early)["verdict"] == "adequate"
    missing, sizes = MISSING["coulomb_friction"]
    (named,) = diagnosed(model, tmp_path, missing, early=early)["findings"]
    assert named["effect"] == "coulomb_friction"
    assert named["parameters"]["coulomb_friction.torque"]["value"] == pytest.approx(sizes["torque"], rel=0.01)


@pytest.mark.parametrize("effect", of_many(UNLISTED, "cubic drag"))
def test_effect_outside_the_catalogue_is_unknown(effect: str, model: Path, tmp_path: Path) -> None:
    found = diagnosed(model, tmp_path, UNLISTED[effect])
    assert found["verdict"] == "unknown"
    assert "depends on rate" in found["reason"]


def test_correct_model_is_adequate(model: Path, tmp_path: Path) -> None:
    assert diagnosed(model, tmp_path)["verdict"] == "adequate"


@pytest.mark.thorough
def test_missing_effect_is_found_in_a_model_without_process_noise(model: Path, tmp_path: Path) -> None:
    exact = tmp_path / "exact.toml"
    exact.write_text(re.sub(r"process_noise = .*\n", "", model.read_text()))
    found = diagnosed(exact, tmp_path, MISSING["end_stop"][0])
    assert [each["effect"] for each in found["findings"]] == ["end_stop"]


def test_added_effect_explains_the_held_out_error(model: Path, tmp_path: Path) -> None:
    recordings = [
        pendulum_plant.write(tmp_path / f"{seed}.csv", MISSING["coulomb_friction"][0], seed=seed)
        for seed in (SEED, SEED + 1)
    ]
    added = upright(
        "model", "add", model, "coulomb_friction", "-o", tmp_path / "mine.toml",
        "--recording", recordings[0], "--held-out", recordings[1],
    )  # fmt: skip
    budget = added["repair"]["budget"]
    assert budget["effect"] > 0.99 * (budget["effect"] + budget["unexplained"])


def test_nothing_of_a_vehicle_is_used_for_a_model_file(model: Path, tmp_path: Path) -> None:
    run = pendulum_plant.write(tmp_path / "run.csv", seed=SEED)
    compared = upright("compare", run, "--model", model)["models"]
    assert [each["name"] for each in compared] == ["pendulum"]
    document = upright("identify", run, "--model", model, "-m", "prediction_error")
    # The model's own value, not the CAD value of a cabin, 1450 kg m^2.
    assert document["before"]["inertia"] == {"value": 0.5, "std": 0.1, "unit": "kg m^2"}
    inertia = document["methods"]["prediction_error"]["parameters"]["inertia"]
    # The motor constant is known to 7 %, and so is every estimate in newton metres.
    assert inertia["value"] == pytest.approx(pendulum_plant.INERTIA, abs=2.0 * inertia["std"])
    assert inertia["std"] < 0.1 * inertia["value"]
    # Beyond 5 deg the cabin of the default vehicle would lie on its support.
    shown = CliRunner().invoke(app, ["diagnose", str(run), "--model", str(model)])
    assert "drive_age" not in shown.output
