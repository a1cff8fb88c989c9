"""The change points at which a step would explain most, compared with steps that are computed one by one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from virtual_records import multisine

from upright.diagnosis.fits.refit import full
from upright.diagnosis.prepare.candidates import candidates_for
from upright.diagnosis.prepare.workspace import Workspace, attached
from upright.diagnosis.score.change_points import MOST, at_instants
from upright.diagnosis.score.whitened import Whitened, project
from upright.estimators.identify.run import with_values
from upright.telemetry.recording import Recording
from upright.vehicles.file import load
from upright.vehicles.registry import nominal_model

VEHICLE = load("monocab")
MODEL = with_values(
    nominal_model("monocab").remove("static_torque"), VEHICLE.parameters.values, VEHICLE.parameters.deviations
)


def in_two(recording: Recording) -> Recording:
    """The recording with a second of unknown angle in it: two segments, of which the second is longer."""
    time = recording.time - recording.time[0]
    roll = recording["roll"].copy()
    roll[(time > 15.0) & (time < 16.0)] = np.nan
    return replace(recording, values={**recording.values, "roll": roll})


@pytest.mark.timeout(300)
def test_best_change_points_match_steps_computed_one_by_one() -> None:
    recording = in_two(multisine("torque_step=0.05"))
    workspace = Workspace.of(MODEL, [recording], VEHICLE.support, ["torque_step"])
    assert len(workspace.segments) == 2
    base = full(MODEL, workspace)
    white = Whitened.of(base.fit)
    candidate = candidates_for(MODEL, [recording], ["torque_step"])[0][0]
    problem = workspace.problem(attached(MODEL, [candidate]))
    found = at_instants(candidate, white, problem)
    # Those with the usual rise first, then those with the sharpest.
    assert found.picked == 2 * MOST
    start, rise = candidate.attached.qualified("start"), candidate.attached.qualified("rise")
    usual, sharp = found.variants[-2 * MOST : -MOST], found.variants[-MOST:]
    assert {shape[rise] for shape in usual} == {candidate.variants[0][rise]}
    (lower,) = {shape[rise] for shape in sharp}
    assert lower == next(each.lower for each in candidate.attached.parameters if each.name == rise)
    tried = [float(shape[start]) for shape in usual]

    def explained(instant: float) -> float:
        column = white.directions(problem, candidate.amplitudes[:1], {**candidate.variants[0], start: instant})
        column = project(column, white.nuisance)[:, 0]
        return float((column @ white.residual) ** 2 / (column @ column))

    longer = workspace.segments[1].time
    others = np.arange(longer[0] + 0.5, longer[-1] - 0.5, 0.5).tolist()
    # The step rises within 0.3 s: between two change points that are tried it explains a little more than at them.
    assert explained(tried[0]) > 0.99 * max(explained(each) for each in others)
    assert explained(tried[0]) >= explained(tried[1])
