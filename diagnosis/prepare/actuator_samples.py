"""The samples from which actuators are diagnosed: at the times at which the drives were sampled, off the support.

Interpolated linearly between two samples, a rate would lose its fastest content, which was mistaken for a further lag
of 2 ms and for noise that is not white. So the drives' own samples are used, and setpoints are shifted to them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from upright.estimators.data.segments import SUPPORT_MARGIN, channels_of, recorded_support
from upright.models.model import Model
from upright.models.natural_time import USUAL, natural_time
from upright.models.parts import Place
from upright.telemetry.recording import Recording

AGE = "drive_age"
SETPOINT_AGE = "setpoint_age"
"""Channels, s."""
AWAY = 5.0
"""Natural times (models.natural_time; 2 s of the MONOCAB) after the vehicle has left its support, after which its
actuators are no longer at their limits."""
ENOUGH = 50.0
"""Natural times of each recording that are used to diagnose the actuators: their sensors hardly have noise."""


def of_actuators(model: Model) -> bool:
    """Whether `model` is of actuators alone, with their command as input."""
    return bool(model.actuators) and not model.joints


def looked_at(model: Model, recordings: Sequence[Recording], support: float | None) -> list[Recording]:
    """The part of `recordings` from which an actuator's `model` is diagnosed, its setpoints shifted by the drives' age.

    Without `support` (rad), that of the recording's metadata, if it has one.
    """
    enough = ENOUGH * (natural_time(model) or USUAL)
    return [_setpoints_later(middle(away_from_support(each, model, support), model, enough)) for each in recordings]


def at_samples(model: Model) -> Model:
    """`model` with one sample for each time at which the drives are sampled, and its setpoints as much later as the
    samples are older."""
    inputs = tuple(replace(each, age=SETPOINT_AGE) for each in model.inputs)
    return replace(model, inputs=inputs, outputs=tuple(replace(each, age="") for each in model.outputs))


def as_recorded_rows(model: Model, at_rows: Model) -> Model:
    """`at_rows`, which at_samples made of `model` and to which effects and values were added, for the samples as
    recorded."""
    inputs = {each.name: each.age for each in model.inputs}
    outputs = {each.name: each.age for each in model.outputs}
    return replace(
        at_rows,
        inputs=tuple(replace(each, age=inputs[each.name]) for each in at_rows.inputs),
        outputs=tuple(replace(each, age=outputs[each.name]) for each in at_rows.outputs),
    )


def on_time(recordings: Sequence[Recording], model: Model) -> list[Recording]:
    """`recordings` with readings that are late according to the sensors of `model` shifted to their correct time.

    Otherwise the vehicle's reaction on its actuators would come too late for them: with a gyro 18 ms late that looked
    like a wrong gain of their command, by 0.06 %.
    """
    late: dict[str, float] = {}
    for attached in model.effects:
        for sensor in model.sensors:
            if sensor.name == attached.at and attached.effect.place is Place.SENSOR and attached.effect.delay:
                delay = model.values[attached.qualified(attached.effect.delay)]
                late |= {name: late.get(name, 0.0) + delay for name in (sensor.angle, sensor.rate) if name}
    return [_earlier(each, late) for each in recordings] if late else list(recordings)


def _earlier(recording: Recording, late: Mapping[str, float]) -> Recording:
    time = recording.time
    moved = {
        name: np.interp(time + delay, time, recording[name], right=np.nan)
        for name, delay in late.items()
        if name in recording.values
    }
    return replace(recording, values={**recording.values, **moved})


def _setpoints_later(recording: Recording) -> Recording:
    """`recording` with the ages of the setpoints relative to the drives' samples: negative."""
    if AGE not in recording.values:
        return recording
    sent = recording[SETPOINT_AGE] if SETPOINT_AGE in recording.values else 0.0
    return replace(recording, values={**recording.values, SETPOINT_AGE: sent - recording[AGE]})


def away_from_support(recording: Recording, model: Model, support: float | None) -> Recording:
    """`recording` with the model's outputs known only when the vehicle has been free for AWAY."""
    support = support if support is not None else recorded_support(recording)
    lean = recording.channels.lean
    if support is None or not lean:
        return recording
    carried = ~(np.abs(recording[lean]) < support - SUPPORT_MARGIN)
    time = recording.time
    last = np.maximum.accumulate(np.where(carried, time, -np.inf))
    away = time - last > AWAY * (natural_time(model) or USUAL)
    there = [each.name for each in model.outputs if each.name in recording.values]
    hidden = {name: np.where(away, recording[name], np.nan) for name in there}
    return replace(recording, values={**recording.values, **hidden})


def middle(recording: Recording, model: Model, span: float) -> Recording:
    """`recording` with the model's outputs known for `span` s in the middle of what is known."""
    there = [each for each in channels_of(model) if each in recording.values]
    known = np.all([np.isfinite(recording[each]) for each in there], axis=0)
    if len(there) < len(channels_of(model)) or not known.any():
        return recording
    centre = float(np.median(recording.time[known]))
    inside = np.abs(recording.time - centre) <= 0.5 * span
    hidden = {each.name: np.where(inside, recording[each.name], np.nan) for each in model.outputs}
    return replace(recording, values={**recording.values, **hidden})
