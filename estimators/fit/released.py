"""What a model holds at its CAD value and the recordings tell better: it is estimated then, with that value as prior.

A model holds what most recordings do not tell. A trim mass that moves tells how high it is: held as far off as its file
says, it was something missing that has no name, in 5 of 20 clean records.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from estimators.fit.maximum_likelihood import Fit
from estimators.fit.result import inverse
from models.model import Model

BETTER = 0.5
"""Share of what was known before to which the data have to tell it, were all else that is held exact."""


def released(model: Model, fitted: Fit) -> Model:
    """`model`, to which `fitted` belongs, with such parameters estimated; `model` itself where there are none."""
    task, count = fitted.problem, len(fitted.minimum.common)
    own = {each.name for each in model.base_parameters}
    held = tuple(place for place in task.uncertain if task.model.parameters[place].name in own)
    if not held or not model.joints:
        return model
    information = fitted.information(held)
    across = information[:count, count:]
    known = inverse(information[:count, :count] + np.diag(fitted.prior))
    told = np.diag(information)[count:] - np.einsum("ih,ij,jh->h", across, known, across)
    before = np.array([task.model.parameters[place].std for place in held])
    names = {
        task.model.parameters[place].name
        for place, better in zip(held, told > (BETTER * before) ** -2, strict=True)
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
