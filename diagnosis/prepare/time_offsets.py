"""Adds a time offset to a model whose inputs are exactly on time: no recording is known that well.

Half a sample between a command as it was held and the sample to which it was written makes an error as large as a small
effect: on a table with practically no noise, a twentieth of a sampling step looks like a spring. So if a model states
nothing about its inputs' time, they may be off by half a sampling step. A larger delay is an effect. Inputs never act
early, but a table may make them seem so: if its readings belong to the sample after their command, it is off by a whole
step.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from upright.models.model import Model
from upright.models.parts import Parameter
from upright.telemetry.recording import Recording

OFFSET = "input_offset"
EARLIEST, LATEST = -1.5, 0.5
"""Sampling steps by which the inputs act later than their time stamps."""


def timed(model: Model, recordings: Sequence[Recording]) -> Model:
    """`model` with one offset (s) of all its inputs, of the order of half a sampling step of `recordings`, to be
    estimated. A model that already has a delay, or a parameter of that name, is unchanged."""
    steps = [float(np.median(np.diff(each.timestamp_ns))) * 1e-9 for each in recordings if len(each.timestamp_ns) > 1]
    known = any(each.delays or each.age for each in model.inputs) or any(each.effect.delay for each in model.effects)
    if known or OFFSET in model.values or not model.inputs or not steps:
        return model
    step = max(steps)
    offset = Parameter(
        name=OFFSET,
        unit="s",
        value=0.0,
        std=step / math.sqrt(12.0),
        scale=step / math.sqrt(12.0),
        lower=EARLIEST * step,
        upper=LATEST * step,
        meaning="by which the inputs act later than their time stamps",
    )
    return replace(
        model,
        base_parameters=(*model.base_parameters, offset),
        inputs=tuple(replace(each, delays=(OFFSET,)) for each in model.inputs),
    )


def untimed(model: Model, fitted: Model) -> Model:
    """`fitted`, which derives from what `timed` made of `model`, without the offset, which belongs to the recordings
    and not to the machine, and with those parameters estimated that `model` states."""
    own = {each.name: each for each in model.base_parameters}
    return replace(
        fitted,
        base_parameters=tuple(
            replace(each, estimated=own[each.name].estimated) for each in fitted.base_parameters if each.name in own
        ),
        inputs=model.inputs,
    )
