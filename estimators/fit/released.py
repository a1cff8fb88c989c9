"""Releases parameters that a model holds at CAD values but the data determine better; the CAD value becomes the prior.

A model holds parameters that are not identifiable from most recordings. The height of a trim mass is identifiable if
the mass moves: when it was held with an error as large as its file allows, the diagnosis found something missing
without a name in 5 of 20 clean records.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from upright.estimators.fit.maximum_likelihood import Fit
from upright.estimators.fit.result import inverse
from upright.models.model import Model

BETTER = 0.5
"""A parameter is released if the data determine it to this share of its prior standard deviation, with all other held
parameters exact."""


def released(model: Model, fitted: Fit) -> Model:
    """`model`, to which `fitted` belongs, with such parameters estimated; `model` itself if there are none."""
    task, count = fitted.problem, len(fitted.minimum.common)
    own = {each.name for each in model.base_parameters}
    held = tuple(place for place in task.uncertain if task.model.parameters[place].name in own)
    if not held or not model.joints:
        return model
    information = fitted.information(held)
    across = information[:count, count:]
    known = inverse(information[:count, :count] + np.diag(fitted.prior))
    informed = np.diag(information)[count:] - np.einsum("ih,ij,jh->h", across, known, across)
    before = np.array([task.model.parameters[place].std for place in held])
    names = {
        task.model.parameters[place].name
        for place, better in zip(held, informed > (BETTER * before) ** -2, strict=True)
        if better
    }
    if not names:
        return model
    return replace(
        model,
        base_parameters=tuple(
            replace(each, estimated=True) if each.name in names else each for each in model.base_parameters
        ),
    )
