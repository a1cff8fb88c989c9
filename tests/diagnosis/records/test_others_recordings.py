"""Tables of a MONOCAB from another simulator: a noisy gyro, a loop without delay, a first-order speed loop.

The drives respond to the gyro's noise before its next sample: this response must not be taken for an effect.
Amplitudes are ten or more times the minimum detectable ones. No decision was based on these seeds. That dry friction
and the effects of the command were called unknown was observed on another simulator, which this one resembles.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from thorough import of_many
from typer.testing import CliRunner

from benchmarks.others_recordings import EFFECTS, OthersVehicle, right
from upright.diagnosis.fits.look_ahead import LOOKED_AHEAD, look_ahead_share, looks_ahead
from upright.diagnosis.fits.refit import FullFit, full, with_effect
from upright.diagnosis.prepare.ready import ready
from upright.diagnosis.prepare.workspace import Workspace
from upright.service.cli import app
from upright.service.cli.inputs import load_recording
from upright.vehicles.file import load
from upright.vehicles.registry import nominal_model

pytestmark = pytest.mark.patient

SIZES: dict[str, dict[str, tuple[float, float]]] = {
    "coulomb_friction": {"torque": (25.0, 0.5)},
    "stribeck_friction": {},
    "viscous_friction": {"coefficient": (400.0, 20.0)},
    "input_delay": {"delay": (0.02, 5e-4)},
    "input_gain": {"gain": (-0.15, 2e-3)},
    "input_deadband": {"width": (0.02, 2e-4)},
    # The order of two lags in series, 40 ms and 50 ms, is hardly identifiable.
    "actuator_lag": {"lag": (0.045, 7e-3)},
}
"""Value and tolerance, by parameter."""


def diagnosed(path: Path) -> Any:
    done = CliRunner().invoke(app, ["diagnose", str(path), "--vehicle", "monocab", "--json"], catch_exceptions=False)
    assert done.exit_code == 0, done.output
    return json.loads(done.stdout)


@pytest.mark.parametrize("effect", of_many(SIZES, "coulomb_friction", "input_delay"))
def test_missing_effect_is_found_with_its_parameters(effect: str, tmp_path: Path) -> None:
    found = diagnosed(OthersVehicle(seed=11, **EFFECTS[effect]).write(tmp_path / "theirs.csv"))
    assert found["verdict"] == "missing_effect", found["reason"]
    assert right(effect, found)
    (named,) = found["findings"]
    assert named["effect"] == effect
    for name, (size, within) in SIZES[effect].items():
        assert named["parameters"][f"{effect}.{name}"]["value"] == pytest.approx(size, abs=within)


def test_correct_model_is_adequate(tmp_path: Path) -> None:
    found = diagnosed(OthersVehicle(seed=12).write(tmp_path / "theirs.csv"))
    assert found["verdict"] == "adequate", found["reason"]


@pytest.fixture(scope="module")
def workspace(tmp_path_factory: pytest.TempPathFactory) -> Workspace:
    """With hidden dry friction. The formula of backlash can reproduce the noise of a sample in advance here."""
    path = OthersVehicle(seed=13, **EFFECTS["coulomb_friction"]).write(tmp_path_factory.mktemp("theirs") / "theirs.csv")
    recording, vehicle = load_recording(path, "monocab"), load("monocab")
    model = ready(nominal_model("monocab").remove("static_torque"), [recording])
    return Workspace.of(model, [recording], vehicle.support, ("coulomb_friction", "backlash"))


@pytest.fixture(scope="module")
def base(workspace: Workspace) -> FullFit:
    return full(ready(nominal_model("monocab").remove("static_torque"), workspace.recordings), workspace)


class TestLookAhead:
    def fitted(self, base: FullFit, workspace: Workspace, effect: str, begin: Mapping[str, float]) -> FullFit:
        candidate = next(each for each in workspace.candidates if each.name == effect)
        end = replace(base.fit.end, values={**base.fit.end.values, **begin})
        return full(with_effect(base.model, candidate, {}), workspace, candidate, end)

    def test_correct_fit_is_causal_and_a_non_causal_fit_is_detected(self, base: FullFit, workspace: Workspace) -> None:
        right = self.fitted(base, workspace, "coulomb_friction", {"coulomb_friction.torque": 10.0})
        rate = [each.name for each in base.model.outputs].index("roll_rate")
        assert look_ahead_share(right.fit, rate)[0] == pytest.approx(0.0, abs=0.02)
        assert not looks_ahead(right.fit, base.fit)
        # One sample ahead, with a shaft so soft that there is nothing but its twist.
        soft = {"backlash.width": 2e-4, "backlash.torque": 1.0, "backlash.load_inertia": 30.0}
        wrong = self.fitted(base, workspace, "backlash", {**soft, "drive_offset": -0.005})
        assert wrong.log_likelihood > right.log_likelihood
        assert look_ahead_share(wrong.fit, rate)[0] > 2.0 * LOOKED_AHEAD
        assert looks_ahead(wrong.fit, base.fit)

    def test_look_ahead_share_of_too_few_samples_is_undetermined(self, base: FullFit) -> None:
        segment = base.fit.problem.segments[0]
        short = replace(segment, time=segment.time[:60], measured=segment.measured[:60])
        few = replace(base.fit, problem=replace(base.fit.problem, segments=(short,)))
        assert look_ahead_share(few, 1) == (0.0, np.inf)
