"""A model whose inputs are on time to the instant is given an offset: no recording is known that well.

Half a sample between a command as it was held and the row that it was written to makes an error as large as what a
small effect does: on a table without noise to speak of, a twentieth of one looks like a spring. So where a model says
nothing of its inputs' time, they may be off by half a step of the rows. What is later than that is an effect, a delay.
None is early, though: a table whose readings are of the row after their command is off by a whole step.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from models.model import Model
from models.parts import Parameter
from telemetry.recording import Recording

OFFSET = "input_offset"
EARLIEST, LATEST = -1.5, 0.5
"""Steps of the rows by which the inputs act after what their rows say."""


def timed(model: Model, recordings: Sequence[Recording]) -> Model:
    """`model` with one offset (s) of all its inputs, of the order of half a step of the rows of `recordings`, to be
    estimated. One that has a delay already, or a parameter of that name, is as it was."""
    steps = [float(np.median(np.diff(each.timestamp_ns))) * 1e-9 for each in recordings if len(each.timestamp_ns) > 1]
    told = any(each.delays or each.age for each in model.inputs) or any(each.effect.delay for each in model.effects)
    if told or OFFSET in model.values or not model.inputs or not steps:
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
        meaning="by which the inputs act later than their rows say",
    )
    return replace(
        model,
        base_parameters=(*model.base_parameters, offset),
        inputs=tuple(replace(each, delays=(OFFSET,)) for each in model.inputs),
    )


def untimed(model: Model, fitted: Model) -> Model:
    """`fitted`, which came of what `timed` made of `model`, without the offset, which is the recordings' and not
    the machine's, and with the parameters estimated that `model` says."""
    own = {each.name: each for each in model.base_parameters}
    return replace(
        fitted,
        base_parameters=tuple(
            replace(each, estimated=own[each.name].estimated) for each in fitted.base_parameters if each.name in own
        ),
        inputs=model.inputs,
    )
