"""Effects hidden in the virtual cube are found, at its edge and at its wheel; without one, nothing is found."""

from __future__ import annotations

import pytest
from thorough import of_many

from upright.diagnosis.diagnose import Diagnosis, diagnose
from upright.diagnosis.findings import Verdict
from upright.service.virtual.run import record
from upright.simulation.cube.hidden import AT_THE_WHEEL, CUBE, CUBE_HIDDEN
from upright.vehicles.file import load
from upright.vehicles.registry import models_of, recorded_loop

VEHICLE = load("cube")
SEED, EXCITED = 41, 20.0
CANDIDATES = (
    "static_torque",
    "viscous_friction",
    "coulomb_friction",
    "quadratic_drag",
    "input_delay",
    "input_deadband",
    "sensor_delay",
    "sensor_scale",
)
"""The effects that a person would suspect first, each at all places."""
WITHIN = 3.0
"""Standard deviations that an amplitude may be off."""


def found(*hide: str) -> Diagnosis:
    recording = record("cube", "multisine", hide=hide, seed=SEED, duration=EXCITED)
    return diagnose(
        models_of(VEHICLE).nominal,
        [recording],
        support=VEHICLE.support,
        candidates=CANDIDATES,
        loops=[recorded_loop(VEHICLE, recording)],
    )


@pytest.mark.parametrize(
    "hidden",
    of_many(("coulomb_friction", "wheel_coulomb_friction", "viscous_friction", "input_deadband"), "coulomb_friction"),
)
def test_hidden_effect_is_found_with_its_amplitude(hidden: str) -> None:
    diagnosis = found(hidden, "disturbance")
    first = diagnosis.findings[0]
    assert AT_THE_WHEEL.get(hidden, hidden) in (first.effect, *first.tied_with)
    size = next(iter(first.parameters.values()))
    assert size.value is not None
    assert size.std is not None
    assert abs(size.value - CUBE_HIDDEN[hidden].size) < WITHIN * size.std


@pytest.mark.parametrize("level", [0.0, 1.0])
def test_cube_without_hidden_effect_is_adequate_and_its_disturbance_estimated(level: float) -> None:
    diagnosis = found(f"disturbance={level:g}")
    assert diagnosis.verdict is Verdict.ADEQUATE, diagnosis.reason
    (tilt,) = diagnosis.disturbance
    assert tilt.shown is (level > 0.0)
    if level:
        assert tilt.std == pytest.approx(CUBE.disturbance.rms, rel=0.2)
