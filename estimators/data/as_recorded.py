"""A model with the sensors that a record shows, where these are not those that the model knows.

A model may say that a sensor's noise is known, and that a filter made one reading of another: then the angle is the
integrated rate to a millionth. Where the record's angle has white noise of its own, many times that, it was measured
otherwise: its noise is then estimated as that of any other sensor, is not the integral of another one's, and no filter
takes errors of the rate, or an accelerometer's, into the angle.

Where the record counts in steps, and no more noise shows than these make, the output is what an encoder shows: it is
`counted`, with the noise of a quantiser (estimators.data.quantised).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from estimators.data.quantised import quantisation_noise
from estimators.data.white_noise import white_variance
from models.model import Model
from telemetry.recording import Recording

SHOWN = 3.0
"""Times the noise that a model knows above which a record contradicts it."""
ALONE = 2.0
"""Times the variance of a quantiser up to which a channel's white noise is the quantiser's, and not a sensor's."""


def as_recorded(model: Model, recordings: Sequence[Recording]) -> Model:
    """`model` with the noise of known sensors freed where `recordings` have more, and starts as uncertain as these;
    what counts in steps there is counted."""
    return _counted(_released(model, recordings), recordings)


def _counted(model: Model, recordings: Sequence[Recording]) -> Model:
    steps = {
        each.name: quantisation_noise(each.name, recordings)
        for each in model.outputs
        if not (each.noise_known or each.counted)
    }
    told = {
        name: noise
        for name, noise in steps.items()
        if noise > 0.0 and _white_noise(name, recordings) ** 2 <= ALONE * noise**2
    }
    if not told:
        return model
    return replace(
        model,
        outputs=tuple(
            replace(each, noise=told[each.name], counted=True) if each.name in told else each for each in model.outputs
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
        # What an effect has for the filter goes with it.
        effects=tuple(
            replace(each, states=each.states[: len(each.effect.states)]) if each.at in apart else each
            for each in model.effects
        ),
    )


def _white_noise(name: str, recordings: Sequence[Recording]) -> float:
    """Standard deviation of the white noise on a channel; 0 where it is not recorded."""
    known = [each[name][np.isfinite(each[name])][:, None] for each in recordings if name in each.values]
    parts = [each for each in known if len(each) > 10]
    return float(np.sqrt(white_variance(parts)[0][0])) if parts else 0.0
