"""What the balancing robot's model lacks, hidden in the virtual robot, found and added from the command line.

`upright diagnose RECORDING -v twsbr` gets only the recording and a few effects to look for (all of them take longer).
`upright model add` with three other experiments held out reports by how much the error falls on data not fitted.
"""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import golden
import pytest
from thorough import of_many
from typer.testing import CliRunner

from upright.diagnosis.diagnose import diagnose
from upright.estimators.identify.run import with_values
from upright.service.cli import app
from upright.service.virtual.run import record
from upright.simulation.twsbr.hidden import TWSBR
from upright.telemetry.storage import save
from upright.vehicles.file import load
from upright.vehicles.registry import nominal_model

SEED = 83
"""No decision was based on it."""
EXCITED = 16.0
"""s of excitation: without getting up and lying down a little more remains than the gate requires."""
LOOKED_FOR = ("static_torque", "coulomb_friction", "viscous_friction", "input_deadband")
"""At all places: a torque on the tilt and one on the wheels are two effects."""
HIDDEN = {
    "static_torque": ("static_torque", "tilt", "static_torque.torque", 0.01),
    "slope": ("static_torque@travel", "travel", "static_torque@travel.torque", -9.3e-3),
    "input_deadband": ("input_deadband", "motors", "input_deadband.width", 0.6),
    "coulomb_friction": ("coulomb_friction@wheels", "wheels", "coulomb_friction@wheels.torque", 0.02),
}
"""Hidden effect: its name in the model, its place, the name of its amplitude and the plant's value (a slope of 2 deg is
-(m_b + 2 m_w) g r sin, and friction that of both gears)."""
WITHIN = 3.0
"""Standard deviations by which an estimate may be off."""
CLOSED = 0.9
"""Share of the held-out error energy above the sensors', half a second ahead, that the added effect removes."""

pytestmark = [pytest.mark.timeout(400), pytest.mark.patient]  # a diagnosis has 300 s


def upright(*arguments: Any) -> Any:
    done = CliRunner().invoke(app, [*map(str, arguments), "--json"], catch_exceptions=False)
    assert done.exit_code == 0, done.output
    return json.loads(done.stdout)


def recorded(experiment: str, folder: Path, *hide: str, seed: int = SEED, duration: float = EXCITED) -> Path:
    """A robot in a draught, like one that a user starts."""
    path = folder / f"{experiment}.arrow"
    save(golden.recorded("twsbr", experiment, hide=["disturbance", *hide], seed=seed, duration=duration), path)
    return path


def diagnosed(recording: Path) -> Any:
    names = [word for name in LOOKED_FOR for word in ("--effect", name)]
    # A machine that has other work must not end the search: the default is 60 s.
    return upright("diagnose", recording, "--vehicle", "twsbr", "--budget", 300, *names)


@pytest.mark.parametrize("hidden", of_many(HIDDEN, "coulomb_friction"))
def test_hidden_effect_is_found_with_its_amplitude(hidden: str, tmp_path: Path) -> None:
    name, _, size, true = HIDDEN[hidden]
    found = diagnosed(recorded("square", tmp_path, hidden))
    assert found["verdict"] == "missing_effect", found["reason"]
    assert found["findings"][0]["effect"] == name
    estimate = found["findings"][0]["parameters"][size]
    assert abs(estimate["value"] - true) < WITHIN * estimate["std"]


@pytest.mark.thorough
def test_friction_is_found_beside_a_disturbance_that_imitates_it() -> None:
    """In the fit of the model alone, the disturbance imitates the friction of the gears."""
    file = load("twsbr")
    model = with_values(nominal_model("twsbr"), file.parameters.values, file.parameters.deviations)
    still = record("twsbr", "square", hide=["coulomb_friction"], seed=SEED, duration=EXCITED)
    found = diagnose(model, [still], support=file.support, candidates=LOOKED_FOR, most=1)
    assert [each.effect for each in found.findings] == ["coulomb_friction@wheels"]


@pytest.mark.parametrize("level", of_many([0.0, 1.0, 2.0], 1.0))
def test_draught_without_a_hidden_effect_is_reported_as_a_disturbance(level: float, tmp_path: Path) -> None:
    found = diagnosed(recorded("square", tmp_path, f"disturbance={level:g}"))
    assert found["verdict"] == "adequate", found["reason"]
    draught, estimate = TWSBR.disturbance, found["disturbance"]["tilt"]
    assert estimate["shown"] is (level > 0.0)
    if level:
        # All torques are proportional to the motors' gain, which the body's mass determines to a few tenths.
        assert abs(math.log(estimate["rms"] / (level * draught.rms))) < 0.5
        assert abs(estimate["correlation_time"] - draught.correlation_time) < WITHIN * estimate["correlation_time_std"]


def test_added_torque_explains_the_error_of_three_held_out_experiments(tmp_path: Path) -> None:
    name, place, _, _ = HIDDEN["static_torque"]
    square, model = recorded("square", tmp_path, name), tmp_path / "repaired.toml"
    others = [recorded(experiment, tmp_path, name) for experiment in ("sine", "doublet", "sine_stream")]
    held_out = [each for other in others for each in ("--held-out", other)]
    revision = upright(
        "model", "add", "twsbr", name, "--at", place, "--vehicle", "twsbr", "--output", model,
        "--recording", square, *held_out,
    )["repair"]  # fmt: skip
    assert revision["needed"]
    closed, left = revision["budget"]["effect"], revision["budget"]["unexplained"]
    assert closed > CLOSED * (closed + left)


@pytest.mark.thorough
def test_added_friction_explains_another_experiment_as_well(tmp_path: Path) -> None:
    """On this record a fit that started without friction ended at four times the motors' resistance, and the error of
    the sine in `compare` was 13 times the noise."""
    hide = "coulomb_friction"
    square, sine = (recorded(each, tmp_path, hide, seed=804, duration=20.0) for each in ("square", "sine"))
    model = tmp_path / "repaired.toml"
    upright(
        "model", "add", "twsbr", hide, "--at", "wheels", "--vehicle", "twsbr", "--output", model,
        "--recording", square, "--held-out", sine,
    )  # fmt: skip
    cad, revised = upright("compare", sine, "--vehicle", "twsbr", "--model", model)["models"]
    assert cad["innovation_ratio"] > 10.0
    assert revised["innovation_ratio"] < 1.2


@pytest.mark.parametrize(
    ("hidden", "least"),
    of_many(
        [(("static_torque",), 5.0), (("static_torque", "disturbance=0"), 30.0), ((), None)],
        (("static_torque",), 5.0),
    ),
)
def test_torque_is_needed_only_if_there_is_one(hidden: tuple[str, ...], least: float | None, tmp_path: Path) -> None:
    """Its amplitude is known to a third only, like the mass of the body. Its presence is certain, in still air by the
    square root of a log-likelihood ratio of thousands. The last third of the recording itself is held out."""
    square = recorded("square", tmp_path, *hidden)
    revision = upright(
        "model", "add", "twsbr", "static_torque", "--at", "tilt", "--vehicle", "twsbr",
        "--output", tmp_path / "repaired.toml", "--recording", square,
    )["repair"]  # fmt: skip
    assert revision["needed"] is (least is not None)
    assert least is None or revision["surety"] > least
