"""The load that a person put on the vehicle while a recording was made, as a part of the model of this recording.

The experiment asked for it, so that it is not an effect that the model lacks. A person is not as exact as a plan: its
torque, its beginning and its duration are fitted together with whatever else is fitted to the recording.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from pydantic import ValidationError

from upright.models.effect import Role
from upright.models.effects.bias import TORQUE_STEP
from upright.models.model import Model
from upright.telemetry.documents import from_json
from upright.telemetry.errors import RecordingError
from upright.telemetry.recording import Recording
from upright.vehicles.experiment.phases import Phase
from upright.vehicles.sections import LoadSection

LOAD = replace(
    TORQUE_STEP,
    name="load",
    title="load that the experiment asked for",
    equation="F = torque (1 + |x| - |x - 1|) / 2, x = (t - start) / rise",
    force="torque * 0.5 * (1 + abs((time - start) / rise) - abs((time - start) / rise - 1))",
    signature="The mean of the residual torque changes at the time that the experiment announced.",
    onset_of="",
    of_run=True,
    source="Griese et al. (MONOCAB), figure 4: a straight ramp",
)
"""The torque of a load, about the axis that the vehicle falls about."""
SHARE, LATE = 0.2, 1.0
"""Standard deviations of a person: share of the announced torque and ramp, and s of the beginning. Chosen, not
measured."""


def load_of(recording: Recording) -> LoadSection | None:
    """The load that the experiment of `recording` asked for; None if there is none."""
    return asked_for(recording.metadata)


def asked_for(metadata: Mapping[str, str]) -> LoadSection | None:
    """The load that the experiment of a recording with this `metadata` asks for; None if there is none."""
    try:
        asked = from_json(metadata.get("experiment_definition", "{}")).get("load")
        return LoadSection.model_validate(asked) if asked else None
    except (ValueError, AttributeError, ValidationError):
        return None


def refuse_loads(recordings: Sequence[Recording]) -> None:
    """Raises RecordingError if somebody put a load on the vehicle in one of `recordings`: parameters are not to be
    fitted to it without the load, which begins at another time in each recording."""
    for recording in recordings:
        if load_of(recording) is not None:
            raise RecordingError(
                recording.source,
                "",
                "a person put a load on the vehicle in this experiment",
                remedy="use recordings without a load here, for example of the sweep; `upright compare` and `upright "
                "diagnose` take this one, by itself.",
            )


def without_load(model: Model) -> Model:
    """`model` without the loads of recordings: what it says of the vehicle itself."""
    for each in model.effects:
        if each.effect.of_run:
            model = model.remove(each.name)
    return model


def with_load(model: Model, recording: Recording) -> Model:
    """`model` with the load of `recording`. It is unchanged if there is none, if the recording does not show the
    start of the excitation, or if the model has it already."""
    load = load_of(recording)
    if load is None or "phase" not in recording.values:
        return model
    excited = np.flatnonzero(recording["phase"] == Phase.EXCITE)
    if not len(excited) or excited[0] == 0 or any(each.effect.of_run for each in model.effects):
        return model
    return loaded(model, load, float(recording.time[excited[0]]) + load.after)


def loaded(model: Model, load: LoadSection, begins: float) -> Model:
    """`model` with `load` from `begins` s on."""
    found = model.add(LOAD)
    step = found.effects[-1]
    by_role = {Role.INSTANT: begins, Role.DURATION: load.ramp}
    values = {
        step.qualified(each.name): load.torque if each.amplitude else by_role[each.role]
        for each in step.effect.parameters
    }
    fitted = [each.name for each in found.parameters if each.estimated or each.name in values]
    deviations = {name: SHARE * abs(value) for name, value in values.items()}
    for each in step.effect.parameters:
        if each.role is Role.INSTANT:
            deviations[step.qualified(each.name)] = LATE
    return found.change(values, deviations=deviations, estimated=fitted)
