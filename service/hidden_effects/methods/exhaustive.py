"""Baseline: fit each effect of the catalogue in turn by output error on windows, and name the one with the lowest BIC.

    BIC = samples * sum over outputs of ln(mean squared error) + parameters * ln(samples)

It tries one effect at a time, so it can find at most one of two.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from upright.estimators.fit.problem import Problem, problem
from upright.estimators.methods.output_error import fit, longest_window
from upright.models.effect import Effect
from upright.models.effects.catalogue import CATALOGUE
from upright.models.model import Model
from upright.models.parts import ModelError
from upright.service.hidden_effects.methods.answers import ADEQUATE, MISSING, Answer, Found
from upright.telemetry.recording import Recording


def exhaustive_bic(
    model: Model,
    recordings: Sequence[Recording],
    support: float,
    candidates: Sequence[str | Effect] | None = None,
) -> Answer:
    """The effect with the lowest BIC, or none if that is lower. Raises EstimationError and ArithmeticError."""
    window = longest_window(problem(model, recordings, support=support))
    found, nothing = _fitted(problem(model, recordings, support=support, longest=window))
    scores = []
    for each in candidates if candidates is not None else CATALOGUE:
        try:
            with_it = found.add(each)
        except ModelError:
            continue  # this model cannot have the effect, or already has it
        try:
            revised, score = _fitted(problem(with_it, recordings, support=support, longest=window))
        except ArithmeticError:
            continue  # with this effect the simulation diverges
        if np.isfinite(score):
            scores.append((score, with_it.effects[-1].effect.name, revised))
    best = min(scores, key=lambda each: each[0], default=None)
    if best is None or best[0] >= nothing:
        return Answer(ADEQUATE)
    return Answer(MISSING, (Found(best[1]),), best[2])


def _fitted(task: Problem) -> tuple[Model, float]:
    """The model with the fitted values, and its BIC."""
    task, minimum, weights = fit(task)
    outputs = len(weights)
    rows = [len(segment) * outputs for segment in task.segments]
    white = [block.residual[:count].reshape(-1, outputs) for block, count in zip(minimum.blocks, rows, strict=True)]
    errors = np.concatenate(white) @ np.linalg.inv(weights).T
    score = len(errors) * float(np.sum(np.log(np.mean(errors**2, axis=0)))) + len(task.free) * np.log(len(errors))
    values = dict(zip((parameter.name for parameter in task.parameters), minimum.common.tolist(), strict=True))
    return task.model.change(values), float(score)
