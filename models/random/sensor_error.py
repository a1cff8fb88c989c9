"""The random errors of a sensor besides white noise: wander and vibration.

A first-order or narrow-band error (models.random.part) adds to an output, and to the states that integrate the output's
noise, as those of a filter do. diagnosis.fits.random_parts decides whether a record requires one.
"""

from __future__ import annotations

import math
from dataclasses import replace

from upright.models.model import Model
from upright.models.parts import NarrowBand, Output
from upright.models.random.disturbance import narrow_at_joints
from upright.models.random.input_noise import noisy_inputs
from upright.models.random.part import LEAST_ROWS, LEAST_TIMES, RandomPart, first_order, narrow_band
from upright.models.text.expressions import names_in

PREFIX = "error_of_"
FIRST = 5.0
"""Start of the estimation of a first-order error's correlation time, in multiples of the shortest one."""


def with_error(model: Model, output: str, frequency: float | None, step: float, longest: float) -> Model:
    """`model` with a random error of `output`, narrow-band about `frequency` (Hz) or, if that is None, first-order, for
    a record of `longest` s with a sample every `step` s. The estimation of its RMS starts at that of the white
    noise."""
    shown = next(each for each in model.outputs if each.name == output)
    name, meaning = f"{PREFIX}{output}", f"random error of {output}"
    if frequency is None:
        shortest = LEAST_ROWS * step
        bounds = (shortest, max(longest / LEAST_TIMES, 2.0 * shortest))
        part = first_order(name, shown.unit, meaning, shown.noise, min(FIRST * shortest, bounds[1]), bounds)
    else:
        part = narrow_band(name, shown.unit, meaning, NarrowBand(frequency, std=shown.noise), longest)
        # Whether a sensor shows the deflection of a mode, its rate or both is not known: take as much of each.
        one, other = (each.name for each in part.states)
        part = replace(part, shown=f"{math.sqrt(0.5)!r} * ({one} + {other})")
    return _with(model, shown, part)


def at_outputs(model: Model) -> list[tuple[Output, int]]:
    """Each output of `model` that has a random error, with the index of the state that is the error."""
    # The error of a narrow-band pair is the state that the other one drives.
    states = [
        (place, state.name)
        for place, state in enumerate(model.base_states)
        if state.correlation_time and bool(state.frequency) is bool(state.driven_by)
    ]
    return [
        (output, place) for output in model.outputs for place, name in states if name in names_in(output.expression)
    ]


def random_count(model: Model) -> int:
    """Number of parameters of the random parts of `model` besides the first-order disturbance: for each its RMS, its
    correlation time and its frequency; for the noise of an input the share that does not act."""
    parts = [*narrow_at_joints(model), *at_outputs(model)]
    return sum(3 if model.base_states[place].frequency else 2 for _, place in parts) + len(noisy_inputs(model))


def _with(model: Model, shown: Output, part: RandomPart) -> Model:
    states = tuple(
        replace(each, derivative=f"{each.derivative} + {part.shown}") if each.noise_of == shown.name else each
        for each in model.base_states
    )
    outputs = tuple(
        replace(each, expression=f"{each.expression} + {part.shown}") if each is shown else each
        for each in model.outputs
    )
    return replace(
        model,
        base_states=(*states, *part.states),
        base_parameters=(*model.base_parameters, *part.parameters),
        outputs=outputs,
    )
