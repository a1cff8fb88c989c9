"""A model of exact forces is given process noise: nothing that somebody would diagnose is exact.

Without any, its predictor is one long simulation: whatever is missing adds up in it from the first row to the last, the
likelihood has minima beside the right one, and what it takes for the noise of its sensors is what is missing. The noise
is estimated as that of every model; a record that has none brings it down to nothing.
"""

from __future__ import annotations

from dataclasses import replace

from models.expressions import names_in
from models.model import Model

BEGIN = 0.01
"""Times a joint's typical rate, /sqrt(s): where the estimation of its process noise begins."""


def disturbed(model: Model) -> Model:
    """`model`, the rates of its joints with process noise where it states none at all."""
    if any(state.process_noise > 0.0 or state.noise_of for state in model.base_states):
        return model
    noise = {name: BEGIN * joint.rate_scale for joint in model.joints for name in names_in(joint.rate)}
    states = tuple(replace(each, process_noise=noise.get(each.name, 0.0)) for each in model.base_states)
    return replace(model, base_states=states)
