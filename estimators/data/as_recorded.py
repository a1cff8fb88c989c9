"""Adapts the sensors of a model to a record, if the record contradicts them.

A model may state that the noise of a sensor is known, and that a filter computes one reading from another: the angle is
then the integrated rate to a millionth. If the recorded angle has many times as much white noise of its own, it was
measured in another way. Its noise is then estimated as that of any other sensor and is not the integral of another
sensor's noise, and no filter carries errors of the rate, or of an accelerometer, into the angle.

If the record is quantised, and has no more noise than quantisation causes, the output is that of an encoder: it becomes
`counted`, with the noise of a quantiser (estimators.data.quantised).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from upright.estimators.data.quantised import quantisation_noise
from upright.estimators.data.white_noise import white_variance
from upright.models.model import Model
from upright.telemetry.recording import Recording

SHOWN = 3.0
"""A record contradicts the known noise of a model if it has more than this factor of it."""
ALONE = 2.0
"""Up to this factor of the variance of a quantiser, a channel's white noise is attributed to the quantiser alone."""


def as_recorded(model: Model, recordings: Sequence[Recording]) -> Model:
    """`model` adapted to `recordings`: known sensor noise is released if they have more, with initial states as
    uncertain as that noise, and quantised outputs become `counted`."""
    return _counted(_released(model, recordings), recordings)


def _counted(model: Model, recordings: Sequence[Recording]) -> Model:
    steps = {
        each.name: quantisation_noise(each.name, recordings)
        for each in model.outputs
        if not (each.noise_known or each.counted)
    }
    counted = {
        name: noise
        for name, noise in steps.items()
        if noise > 0.0 and _white_noise(name, recordings) ** 2 <= ALONE * noise**2
    }
    if not counted:
        return model
    return replace(
        model,
        outputs=tuple(
            replace(each, noise=counted[each.name], counted=True) if each.name in counted else each
            for each in model.outputs
        ),
    )


def _released(model: Model, recordings: Sequence[Recording]) -> Model:
    noise = {each.name: _white_noise(each.name, recordings) for each in model.outputs}
    released = {each.name for each in model.outputs if each.noise_known and noise[each.name] > SHOWN * each.noise}
    if not released:
        return model
    outputs = tuple(
        replace(each, noise=noise[each.name], noise_known=each.noise_known and each.name not in released)
        for each in model.outputs
    )
    states = tuple(
        replace(
            each,
            derivative=f"-{each.name}" if each.error_of in released else each.derivative,
            noise_of="",
            initial_std=max(each.initial_std, noise.get(each.initial, 0.0)),
        )
        for each in model.base_states
    )
    apart = {sensor.name for sensor in model.sensors if sensor.angle in released}
    return replace(
        model,
        base_states=states,
        outputs=outputs,
        sensors=tuple(replace(each, filter=None) if each.name in apart else each for each in model.sensors),
        # The states that an effect has for the filter are removed with it.
        effects=tuple(
            replace(each, states=each.states[: len(each.effect.states)]) if each.at in apart else each
            for each in model.effects
        ),
    )


def _white_noise(name: str, recordings: Sequence[Recording]) -> float:
    """Standard deviation of the white noise on a channel; 0 if it is not recorded."""
    known = [each[name][np.isfinite(each[name])][:, None] for each in recordings if name in each.values]
    parts = [each for each in known if len(each) > 10]
    return float(np.sqrt(white_variance(parts)[0][0])) if parts else 0.0
