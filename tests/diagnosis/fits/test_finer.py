"""An effect gets its finer formula if a record requires it, so that the remainder of the usual one is not named."""

from __future__ import annotations

from pathlib import Path

import pytest

from upright.diagnosis.diagnose import Verdict, diagnose
from upright.estimators.identify.run import with_values
from upright.models.effects.catalogue import find
from upright.models.file.document import ModelFile
from upright.models.file.model_file import read, write
from upright.models.text.expressions import number
from upright.service.virtual.run import record
from upright.simulation.physics.friction import BRISTLE_DAMPING, BRISTLE_DEFLECTION
from upright.vehicles.file import load
from upright.vehicles.registry import nominal_model

VEHICLE = load("monocab")
MODEL = with_values(
    nominal_model("monocab").remove("static_torque"), VEHICLE.parameters.values, VEHICLE.parameters.deviations
)


@pytest.mark.parametrize(
    "hide",
    [
        pytest.param(("disturbance", "coulomb_friction"), id="disturbed"),
        pytest.param(("coulomb_friction",), id="undisturbed", marks=pytest.mark.thorough),
    ],
)
def test_friction_with_an_elastic_contact_is_the_only_finding(hide: tuple[str, ...]) -> None:
    """With the sign of the rate it was Stribeck friction, backlash beside it, or something that no effect explains."""
    recording = record("monocab", "multisine", hide=hide, seed=6001)
    candidates = ("coulomb_friction", "stribeck_friction", "viscous_friction", "backlash")
    found = diagnose(MODEL, [recording], support=VEHICLE.support, candidates=candidates)
    assert found.verdict is Verdict.MISSING_EFFECT, found.reason
    (named,) = found.findings
    assert (named.effect, named.tied_with) == ("coulomb_friction", ())
    truth = {"torque": 60.0, "travel": BRISTLE_DEFLECTION, "bend_time": BRISTLE_DAMPING}
    for name, value in truth.items():
        assert named.parameters[f"coulomb_friction.{name}"].value == pytest.approx(value, rel=0.1)
    assert "bend_time bend'" in named.explanation


@pytest.mark.parametrize("name", ["coulomb_friction", "stribeck_friction", "asymmetric_friction"])
def test_contact_is_a_spring_before_it_slides_and_usual_friction_after(name: str) -> None:
    usual = find(name)
    finer = usual.finer
    assert finer is not None
    known = dict.fromkeys((parameter.name for parameter in finer.parameters), 0.5) | {"travel": 1e-4, "bend_time": 0.0}
    known |= {"smooth_rate": 1e-3, "time_scale": 0.4, "rate": 0.01}
    (bend,) = finer.states
    assert number(bend.derivative, known | {"bend": 0.0}) == pytest.approx(0.01 / 1e-4, rel=0.2)
    assert number(bend.derivative, known | {"bend": 1.0}) == 0.0
    sliding = number(usual.force, known)
    for share in (0.0, 0.1, 1.0):
        assert number(finer.force, known | {"bend": share}) == pytest.approx(share * sliding)


def test_finer_formula_survives_writing_and_reading_a_model(tmp_path: Path) -> None:
    effect = find("coulomb_friction").finer
    assert effect is not None
    model = MODEL.add(effect).change({"coulomb_friction.torque": 60.0, "coulomb_friction.travel": 1e-4})
    write(ModelFile(model), tmp_path / "mine.toml")
    assert read(tmp_path / "mine.toml").model.effects == model.effects
