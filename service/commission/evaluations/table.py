"""Every evaluation by the name that steps use."""

from __future__ import annotations

from functools import partial
from typing import Any

from upright.service.commission.evaluations import at_rest, course, drives, results
from upright.service.commission.evidence import Evaluation, Evidence, Found
from upright.vehicles import registry
from upright.vehicles.commissioning import CommissioningError


def confirmed(evidence: Evidence) -> Found:
    """Nothing is measured: a person has confirmed what the step asks to prepare."""
    return Found(text=["confirmed"])


EVALUATIONS: dict[str, Evaluation] = {
    "confirmed": confirmed,
    "bus": drives.bus,
    "silence": drives.silence,
    "drives": drives.drives,
    "imu_at_rest": at_rest.imu_at_rest,
    "tilt": at_rest.tilt,
    "course": course.course,
    "identified": results.identified,
    "designed": results.designed,
    "compared": results.compared,
    "diagnosed": results.diagnosed,
    "effects": results.effects,
}


def evaluation(name: str, kind: str) -> Evaluation:
    """The evaluation of this name: one of all vehicles, or one of a kind's own. Raises CommissioningError."""
    own = registry.of(kind).evaluations()
    if name in own:
        return partial(_own, own[name])
    if name not in EVALUATIONS:
        raise CommissioningError(
            f"there is no evaluation {name!r}.", remedy=f"Use one of: {', '.join((*EVALUATIONS, *own))}."
        )
    return EVALUATIONS[name]


def _own(measure: Any, evidence: Evidence) -> Found:
    from upright.service.offline.inputs.replay import load

    return Found(measure(evidence.vehicle, [load(each, evidence.vehicle) for each in evidence.recordings]))
