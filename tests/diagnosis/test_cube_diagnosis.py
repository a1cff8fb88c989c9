"""What is hidden in the virtual cube is found, at its edge and at its wheel; what is right has nothing missing."""

from __future__ import annotations

import pytest
from thorough import of_many

from diagnosis.diagnose import Diagnosis, diagnose
from diagnosis.findings import Verdict
from service.virtual.run import record
from simulation.cube.hidden import AT_THE_WHEEL, CUBE, CUBE_HIDDEN
from vehicles.file import load
from vehicles.registry import models_of, recorded_loop

VEHICLE = load("cube")
SEED, EXCITED = 41, 20.0
LOOKED_FOR = (
    "static_torque",
    "viscous_friction",
    "coulomb_friction",
    "quadratic_drag",
    "input_delay",
    "input_deadband",
    "sensor_delay",
    "sensor_scale",
)
"""What a person would suspect first; all places of each."""
WITHIN = 3.0
"""Standard deviations."""


def found(*hide: str) -> Diagnosis:
    recording = record("cube", "multisine", hide=hide, seed=SEED, duration=EXCITED)
    return diagnose(
        models_of(VEHICLE).nominal,
        [recording],
        support=VEHICLE.support,
        candidates=LOOKED_FOR,
        loops=[recorded_loop(VEHICLE, recording)],
    )


@pytest.mark.parametrize(
    "hidden",
    of_many(("coulomb_friction", "wheel_coulomb_friction", "viscous_friction", "input_deadband"), "coulomb_friction"),
)
def test_what_is_hidden_is_found_with_its_size(hidden: str) -> None:
    told = found(hidden, "disturbance")
    first = told.findings[0]
    assert AT_THE_WHEEL.get(hidden, hidden) in (first.effect, *first.tied_with)
    size = next(iter(first.parameters.values()))
    assert size.value is not None
    assert size.std is not None
    assert abs(size.value - CUBE_HIDDEN[hidden].size) < WITHIN * size.std


@pytest.mark.parametrize("level", [0.0, 1.0])
def test_where_nothing_is_hidden_nothing_is_missing(level: float) -> None:
    told = found(f"disturbance={level:g}")
    assert told.verdict is Verdict.ADEQUATE, told.reason
    (tilt,) = told.disturbance
    assert tilt.shown is (level > 0.0)
    if level:
        assert tilt.std == pytest.approx(CUBE.disturbance.rms, rel=0.2)
