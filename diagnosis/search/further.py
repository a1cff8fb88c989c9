"""How much a further effect has to gain beside those that were found: no formula is exact, and a long record tells.

A formula leaves a share of what its effect explains, its formula error (models.effect.Effect.formula_error), and a
further name may be no more than a part of that. So a further effect has to gain

    sum over the effects found of  formula error x r^2 x log likelihood gained,

r the canonical correlation between what the two do to the innovations of the model alone, as the score test has it at
their usual shapes; 1 for two that the catalogue calls easily confused, since at some shape they are; and LEAST at
least, since what a formula leaves is what it cannot say itself.
Source: the likelihood coarsened by an error of the model, Miller and Dunson, "Robust Bayesian inference via
coarsening", Journal of the American Statistical Association 114 (2019) 1113-1125.
"""

from __future__ import annotations

from collections.abc import Sequence

from diagnosis.findings import Finding
from diagnosis.gates import confusable
from diagnosis.score.score_test import ScoreTest

LEAST = 0.2
"""Of r^2. A fit leaves nothing along its own formula, so that r alone says too little of what is left. With a formula
error of 0.1 it asks for a fiftieth of what was gained: with a twentieth, friction or a torque beside play had no name.
Chosen on these; what a real formula leaves has not been estimated."""


def asked(further: Finding, before: Sequence[Finding], alone: ScoreTest, of_impacts: float = 0.0) -> float:
    """Log likelihood that a `further` effect has to gain, beside those found `before` and beside the effects of the
    model as it was whose parts strike each other, which leave `of_impacts`. `alone`: the score test of that model."""
    left = (
        each.definition.formula_error * _likeness(further, each, alone) * each.log_likelihood_gain for each in before
    )
    return of_impacts + sum(left)


def left_by_formulas(findings: Sequence[Finding]) -> float:
    """Log likelihood of `findings` that says nothing: what their formulas may leave."""
    return sum(each.definition.formula_error * each.log_likelihood_gain for each in findings)


def _likeness(one: Finding, other: Finding, alone: ScoreTest) -> float:
    """r^2 of two effects; 1 where a derivative at none of one says nothing of it, or the score test has it not."""
    effects = one.definition, other.definition
    if confusable(*effects) or any(each.impacts for each in effects):
        return 1.0
    known = {one.effect, other.effect} <= alone.bases.keys()
    return max(LEAST, alone.similarity(one.effect, other.effect) ** 2) if known else 1.0
