"""Backlash in the gears of the balancing robot, hidden in the virtual robot, found and added from the command line.

With the paper's gains a robot with backlash rattles from sample to sample; with softer ones it crosses the gap when its
motors reverse. The motors' encoders do not show this; the body falls through the gap until an impact. The plant has two
gears with elastic teeth that rebound, the model a single position within the backlash that does not.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from thorough import of_many
from typer.testing import CliRunner

from benchmarks.robot_diagnosis import vehicle as vehicle_file
from upright.diagnosis.lack_of_fit.adequacy import LEFT_BY_IMPACTS
from upright.models import library
from upright.service.cli import app
from upright.service.virtual.run import record
from upright.simulation.twsbr.hidden import TWSBR_HIDDEN
from upright.telemetry.storage import save
from upright.vehicles.file import load

SEED = 74
"""No setting was chosen with it."""
RATTLES = 913
"""With this seed the gears rattle on the square wave, 64 times the floor. This seed and 911, in which backlash was not
named, were used to choose where fits begin and how held-out data judge them."""
CANDIDATES = ("backlash", "input_deadband", "coulomb_friction", "actuator_lag")
"""At all places. The whole catalogue takes three minutes."""
OTHERS = ("sine", "doublet", "sine_stream")
WITHIN = 3.0
"""Allowed error of the width in standard deviations, or"""
NEAR = 0.1
"""as a share of the width: if an impact is about to come one sample later, the ± is determined by that sample alone. On
SEED it is 0.4 % of the width, which is 6 % off; on RATTLES 33 %, and the width 15 % off."""

pytestmark = [pytest.mark.timeout(900), pytest.mark.patient]


@pytest.fixture(scope="module")
def vehicle(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The shipped vehicle file with a softer controller."""
    return vehicle_file(tmp_path_factory.mktemp("softer"), softer=True)


def recorded(experiment: str, vehicle: Path, *hide: str, seed: int = SEED) -> Path:
    path = vehicle.parent / f"{experiment}{len(hide)}_{seed}.arrow"
    if not path.exists():
        duration = 20.0 if experiment == "square" else 8.0
        save(record(load(str(vehicle)), experiment, hide=hide, seed=seed, duration=duration), path)
    return path


def upright(*arguments: Any) -> Any:
    done = CliRunner().invoke(app, [*map(str, arguments), "--json"], catch_exceptions=False)
    assert done.exit_code == 0, done.output
    return json.loads(done.stdout)


def diagnosed(recording: Path, vehicle: Path) -> Any:
    names = [word for name in CANDIDATES for word in ("--effect", name)]
    # This tests what is found, not how soon: the machine may be busy.
    return upright("diagnose", recording, "--vehicle", vehicle, "--budget", "inf", *names)


@pytest.mark.parametrize("seed", of_many([SEED, SEED + 1, RATTLES], SEED))
def test_backlash_of_the_gears_is_found_with_its_width(vehicle: Path, seed: int) -> None:
    found = diagnosed(recorded("square", vehicle, "backlash", seed=seed), vehicle)
    assert found["verdict"] == "missing_effect", found["reason"]
    assert [each["effect"] for each in found["findings"]] == ["backlash"], found["reason"]
    width = found["findings"][0]["parameters"]["backlash.width"]
    true = TWSBR_HIDDEN["backlash"].size
    assert abs(width["value"] - true) < max(WITHIN * width["std"], NEAR * true)
    assert width["std"] < width["value"]
    # An impact predicted a sample early or late leaves as large an error as one that is not predicted.
    before, after = (found[f"innovation_ratio_{when}"] - 1.0 for when in ("before", "after"))
    assert after < LEFT_BY_IMPACTS * before
    assert "Impacts that come a sample early or late" in found["reason"]


def test_robot_without_backlash_is_adequate(vehicle: Path) -> None:
    found = diagnosed(recorded("square", vehicle), vehicle)
    assert found["verdict"] == "adequate", found["reason"]


@pytest.fixture(scope="module")
def added(vehicle: Path) -> Any:
    """Output of adding backlash to the robot's model; the new model is beside the vehicle file."""
    others = [each for name in OTHERS for each in ("--held-out", recorded(name, vehicle, "backlash"))]
    return upright(
        "model", "add", "twsbr", "backlash", "--vehicle", vehicle, "--output", vehicle.parent / "repaired.toml",
        "--recording", recorded("square", vehicle, "backlash"), *others,
    )  # fmt: skip


@pytest.mark.thorough
def test_adding_backlash_reduces_the_error_on_three_held_out_experiments(added: Any) -> None:
    """Each model with the filter that was fitted with it: a twentieth of a second ahead in tilt and tilt rate, and a
    fifth of a second ahead in tilt rate."""
    revision = added["repair"]
    assert revision["needed"]
    for channel, horizon, least in (("tilt", 0, 0.05), ("tilt_rate", 0, 0.25), ("tilt_rate", 1, 0.25)):
        before, after = (revision[when]["held_out"][channel][horizon] for when in ("before", "after"))
        assert after < (1.0 - least) * before


@pytest.mark.thorough
def test_nothing_more_is_named_with_backlash_in_the_model(added: Any, vehicle: Path) -> None:
    """An impact predicted a sample early or late leaves an error that a torque with an onset there can explain."""
    assert added["repair"]["needed"]
    found = upright(
        "diagnose", recorded("square", vehicle, "backlash"), "--vehicle", vehicle, "--budget", "inf",
        "--model", vehicle.parent / "repaired.toml", "--effect", "torque_step",
    )  # fmt: skip
    assert found["verdict"] == "adequate", found["reason"]
    assert "Impacts that come a sample early or late" in found["reason"]


@pytest.mark.thorough
@pytest.mark.parametrize("experiment", OTHERS)
def test_compare_shows_a_smaller_error_on_each_held_out_experiment(added: Any, vehicle: Path, experiment: str) -> None:
    """With a filter that was not made from any model's errors. On 17 of 18 longer experiments (the benchmark's, seeds
    74, 803, 805, 807, 808 and 912) the error energy fell by at least 13 %, up to a fifth of a second ahead."""
    output = vehicle.parent / "added.json"
    output.write_text(json.dumps(added), encoding="utf-8")
    models = ["--model", output, "--model", vehicle.parent / "repaired.toml"]
    found = upright("compare", recorded(experiment, vehicle, "backlash"), "--vehicle", vehicle, *models)
    before, after = (each["by_horizon"] for each in found["models"][-2:])
    assert [each["name"] for each in found["models"]] == ["CAD", "without backlash", "repaired"]
    for channel in ("tilt", "tilt_rate"):
        for old, new in zip(before[:2], after[:2], strict=True):
            assert old["horizon"] <= 0.2
            assert (new["rmse"][channel] / old["rmse"][channel]) ** 2 < 0.95, (channel, old["horizon"])


def test_backlash_formula_depends_on_the_place() -> None:
    """A gear whose rotor is a mass of the model, and a gimbal whose motion is imposed on its load."""
    robot, monocab = library.get("twsbr").add("backlash"), library.get("monocab_roll").add("backlash")
    assert {each.name for each in robot.effects[-1].parameters} == {"backlash.width", "backlash.half_width"}
    assert "backlash.load_inertia" in {each.name for each in monocab.effects[-1].parameters}
