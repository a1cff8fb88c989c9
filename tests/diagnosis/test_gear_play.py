"""Play in the gears of the balancing robot, hidden in the virtual robot, found and added from the command line.

With the paper's gains a robot with play rattles from row to row; with softer ones it crosses the gap when its motors
reverse. Seen from the motors nothing moves; the body falls through the gap and is struck. The plant has two gears with
elastic teeth that rebound, the model one place within the play that does not.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from thorough import of_many
from typer.testing import CliRunner

from benchmarks.robot_diagnosis import vehicle as vehicle_file
from diagnosis.lack_of_fit.adequacy import LEFT_BY_IMPACTS
from models import library
from service.cli import app
from service.virtual.run import record
from simulation.twsbr.hidden import TWSBR_HIDDEN
from telemetry.storage import save
from vehicles.file import load

SEED = 74
"""Decided nothing."""
RATTLES = 913
"""Where the square wave rattles, 64 times the floor. On this and 911, whose play had no name, it was decided where fits
begin and how unseen data judge them."""
LOOKED_FOR = ("backlash", "input_deadband", "coulomb_friction", "actuator_lag")
"""At all places. The whole catalogue takes three minutes."""
OTHERS = ("sine", "doublet", "sine_stream")
WITHIN = 3.0
"""Standard deviations that the width may be off, or"""
NEAR = 0.1
"""the share of itself: where a blow is about to come a row later, its ± is of that row alone. On SEED it is 0.4 % of
the width, which is 6 % off; on RATTLES 33 %, and the width 15 % off."""

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
    names = [word for name in LOOKED_FOR for word in ("--effect", name)]
    # On a busy machine a test of what is found is none of how soon.
    return upright("diagnose", recording, "--vehicle", vehicle, "--budget", "inf", *names)


@pytest.mark.parametrize("seed", of_many([SEED, RATTLES], SEED))
def test_play_of_the_gears_is_found_with_its_size(vehicle: Path, seed: int) -> None:
    found = diagnosed(recorded("square", vehicle, "backlash", seed=seed), vehicle)
    assert found["verdict"] == "missing_effect", found["reason"]
    assert [each["effect"] for each in found["findings"]] == ["backlash"], found["reason"]
    width = found["findings"][0]["parameters"]["backlash.width"]
    true = TWSBR_HIDDEN["backlash"].size
    assert abs(width["value"] - true) < max(WITHIN * width["std"], NEAR * true)
    assert width["std"] < width["value"]
    # A blow that comes a row early or late is as large as one that is not expected.
    before, after = (found[f"innovation_ratio_{when}"] - 1.0 for when in ("before", "after"))
    assert after < LEFT_BY_IMPACTS * before
    assert "Impacts that come a sample early or late" in found["reason"]


def test_without_play_none_is_found(vehicle: Path) -> None:
    found = diagnosed(recorded("square", vehicle), vehicle)
    assert found["verdict"] == "adequate", found["reason"]


@pytest.fixture(scope="module")
def added(vehicle: Path) -> Any:
    """What adding it to the robot's model says; the model is beside the vehicle file."""
    others = [each for name in OTHERS for each in ("--held-out", recorded(name, vehicle, "backlash"))]
    return upright(
        "model", "add", "twsbr", "backlash", "--vehicle", vehicle, "--output", vehicle.parent / "repaired.toml",
        "--recording", recorded("square", vehicle, "backlash"), *others,
    )  # fmt: skip


@pytest.mark.thorough
def test_added_the_error_falls_on_three_experiments_that_were_not_fitted(added: Any) -> None:
    """Each model with the filter that was fitted with it: a twentieth of a second ahead in tilt and tilt rate, and in
    this a fifth ahead as well."""
    revision = added["repair"]
    assert revision["needed"]
    for channel, horizon, least in (("tilt", 0, 0.05), ("tilt_rate", 0, 0.25), ("tilt_rate", 1, 0.25)):
        before, after = (revision[when]["held_out"][channel][horizon] for when in ("before", "after"))
        assert after < (1.0 - least) * before


@pytest.mark.thorough
def test_with_it_in_the_model_nothing_more_is_named(added: Any, vehicle: Path) -> None:
    """A blow that comes a row early or late is left to be explained, and some torque that sets in there can."""
    assert added["repair"]["needed"]
    found = upright(
        "diagnose", recorded("square", vehicle, "backlash"), "--vehicle", vehicle, "--budget", "inf",
        "--model", vehicle.parent / "repaired.toml", "--effect", "torque_step",
    )  # fmt: skip
    assert found["verdict"] == "adequate", found["reason"]
    assert "Impacts that come a sample early or late" in found["reason"]


@pytest.mark.thorough
@pytest.mark.parametrize("experiment", OTHERS)
def test_compared_it_falls_on_each_of_them(added: Any, vehicle: Path, experiment: str) -> None:
    """Through a filter that no model's errors made. Of 18 longer experiments (the benchmark's, seeds 74, 803, 805, 807,
    808 and 912) 13 % of the error's energy went at least on 17, up to a fifth of a second ahead."""
    said = vehicle.parent / "added.json"
    said.write_text(json.dumps(added), encoding="utf-8")
    models = ["--model", said, "--model", vehicle.parent / "repaired.toml"]
    found = upright("compare", recorded(experiment, vehicle, "backlash"), "--vehicle", vehicle, *models)
    before, after = (each["by_horizon"] for each in found["models"][-2:])
    assert [each["name"] for each in found["models"]] == ["CAD", "without backlash", "repaired"]
    for channel in ("tilt", "tilt_rate"):
        for old, new in zip(before[:2], after[:2], strict=True):
            assert old["horizon"] <= 0.2
            assert (new["rmse"][channel] / old["rmse"][channel]) ** 2 < 0.95, (channel, old["horizon"])


def test_the_formula_is_that_of_the_place() -> None:
    """A gear whose rotor is a mass of the model, and a gimbal whose motion is imposed on what it moves."""
    robot, monocab = library.get("twsbr").add("backlash"), library.get("monocab_roll").add("backlash")
    assert {each.name for each in robot.effects[-1].parameters} == {"backlash.width", "backlash.half_width"}
    assert "backlash.load_inertia" in {each.name for each in monocab.effects[-1].parameters}
