"""Each effect of the catalogue, hidden in the virtual vehicle on the bus, is found, undone and added as by any user.

`upright diagnose RECORDING --auto MODEL` writes the revised model, `upright model undo` removes its effects, and
`upright model add MODEL EFFECT` with the recording adds the effect that the diagnosis named, fitted to the first two
thirds and validated on the last. The tool gets nothing but the recording; the amplitudes are those of `upright demo
--hide EFFECT`.
"""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import pytest
from thorough import of_many
from typer.testing import CliRunner

from benchmarks.beside_disturbance import LEARNED, LEVELS
from upright.models.effects.catalogue import CATALOGUE
from upright.models.file.model_file import read
from upright.models.parts import Place
from upright.service.cli import app
from upright.service.virtual.run import record
from upright.simulation.monocab.hidden import HIDDEN
from upright.telemetry.storage import save

pytestmark = pytest.mark.patient

SEED, ANOTHER = 61, 81
"""No setting was chosen with these."""
COMMANDED = {each.name for each in CATALOGUE.values() if each.place is Place.ACTUATOR}
CREEPS = {"torque_drift"}
"""Validated on another run: the plant has crept since it was switched on, 3 s before the record begins. No formula
includes this, and the third of a run after the fitted ones depends on exactly that."""
SIZED = {"cubic_stiffness": "coefficient", "flexible_mode": "share"}
"""Effects with a value that has to be right within a tenth: the plant's hardening is a sinh. Others: test_diagnose."""
CLOSED = 0.97
"""Share of the held-out error energy in excess of the sensors', half a second ahead, that an effect has to remove.
Bristles are not quite tanh: the formula of Stribeck friction leaves a fiftieth of what the plant does."""
FLOOR = 1.05
"""Ratio of the error energy to that of the sensors below which nothing is left to remove."""

EVERY_TIME = ("coulomb_friction", "cubic_stiffness", "input_delay", "sensor_offset", "torque_step")
"""Forces, the command, a sensor, and an effect with an onset."""


def upright(*arguments: Any) -> Any:
    done = CliRunner().invoke(app, [*map(str, arguments), "--json"], catch_exceptions=False)
    assert done.exit_code == 0, done.output
    return json.loads(done.stdout)


def recorded(effect: str, folder: Path, seed: int = SEED) -> Path:
    path = folder / f"{effect or 'clean'}{seed}.arrow"
    # 20 s are more than the gate requires.
    hide = (LEVELS.get(effect, effect),) if effect else ()
    save(record("monocab", "multisine", hide=hide, seed=seed, duration=20.0), path)
    return path


def added(file: Path, effect: str, recording: Path, *held_out: Path) -> Any:
    """Output of `model add` for `effect` in the model of `file`, after all its effects were undone."""
    while read(file).history:
        upright("model", "undo", file)
    others = [word for each in held_out for word in ("--held-out", each)]
    return upright("model", "add", file, effect, "--recording", recording, *others)["repair"]


def test_virtual_vehicle_can_hide_all_effects_except_nonlinear_gravity() -> None:
    # The restoring torque of gravity is the sine of roll in the plant already.
    assert {*CATALOGUE} - {*HIDDEN} == {"gravity_nonlinearity"}


@pytest.mark.timeout(900)
@pytest.mark.parametrize("effect", of_many(sorted(HIDDEN.keys() - {LEARNED}), *EVERY_TIME))
def test_hidden_effect_is_found_and_adding_it_reduces_the_error(effect: str, tmp_path: Path) -> None:
    recording, model = recorded(effect, tmp_path), tmp_path / "repaired.toml"
    # This tests what is found, not how soon: the machine may be busy.
    found = upright("diagnose", recording, "--auto", model, "--budget", "inf")
    assert found["verdict"] == "missing_effect", found["reason"]
    named = next(each for each in found["findings"] if effect in {each["effect"], *each["tied_with"]})
    assert named is found["findings"][0]
    assert len(named["tied_with"]) <= 1
    if effect in SIZED:
        size = named["parameters"][f"{effect}.{SIZED[effect]}"]["value"]
        assert size == pytest.approx(HIDDEN[effect].size, rel=0.1)
    file = model if named["effect"] in {each.name for each in read(model).model.effects} else actuators(model)
    other_run = [recorded(effect, tmp_path, ANOTHER)] if effect in CREEPS else []
    revision = added(file, named["effect"], recording, *other_run)
    assert revision["needed"]
    sensors, closed, left = (revision["budget"][each] for each in ("sensors", "effect", "unexplained"))
    if effect in COMMANDED:
        # The formula of the gimbals' speed loop leaves errors of its own, whatever is hidden.
        assert revision["held_out_error_fall_percent"] > 0.0
        bare = tmp_path / "bare.toml"
        bare.write_text(re.sub(r"^actuators_model = .*\n", "", model.read_text(), flags=re.M))
        after, before = (loop_error(recording, each) for each in (model, bare))
        assert after < before
    else:
        assert closed > CLOSED * (closed + left) or sensors + left < FLOOR * sensors


def loop_error(recording: Path, model: Path) -> float:
    """Of the gimbals in the simulated closed loop, over that of the noise."""
    found = upright("compare", recording, "--model", model)["models"]
    errors: dict[str, float] = next(each for each in found if each["name"] == model.stem)["closed_loop"]["over_floor"]
    return errors["precession_rate"]


def actuators(model: Path) -> Path:
    return model.with_name(f"{model.stem}-actuators.toml")


def test_effect_that_the_filter_has_learned_is_not_a_candidate(tmp_path: Path) -> None:
    found = upright("diagnose", recorded(LEARNED, tmp_path))
    assert found["verdict"] == "adequate"
    assert "learned" in found["not_candidates"][LEARNED]


def test_record_without_hidden_effect_is_adequate(tmp_path: Path) -> None:
    assert upright("diagnose", recorded("", tmp_path))["verdict"] == "adequate"
