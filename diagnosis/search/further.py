"""How much a further effect must raise the log-likelihood, given the findings so far: no formula is exact, and a long
record shows it.

A formula leaves a share of what its effect explains, its formula error (models.effect.Effect.formula_error), and a
further effect may be no more than a part of that. So a further effect must raise the log-likelihood by

    sum over the effects found of  formula error x r^2 x their log-likelihood ratio,

r the canonical correlation between what the two do to the innovations of the model alone, as in the score test at their
usual shapes; 1 for two that the catalogue calls easily confused, since at some shape they are; and r^2 is LEAST at
least, since what a formula leaves is by definition outside its own span.
Source: the likelihood coarsened by an error of the model, Miller and Dunson, "Robust Bayesian inference via
coarsening", Journal of the American Statistical Association 114 (2019) 1113-1125.
"""

from __future__ import annotations

from collections.abc import Sequence

from upright.diagnosis.findings import Finding
from upright.diagnosis.gates import confusable
from upright.diagnosis.prepare.candidates import Candidate
from upright.diagnosis.score.score_test import ScoreTest

LEAST = 0.2
"""Lower limit of r^2. A fit leaves nothing along its own formula, so r alone underestimates what is left. With a
formula error of 0.1 it requires a fiftieth of the log-likelihood ratio so far: with a twentieth, friction or a torque
in addition to backlash was not named. Chosen on these cases; what a real formula leaves has not been estimated."""


def left_for(further: Candidate, before: Sequence[Finding], alone: ScoreTest) -> float:
    """Log-likelihood ratio that the formulas of the effects found `before` may leave for a `further` effect. `alone`:
    the score test of the model without any of them."""
    return sum(
        each.definition.formula_error * _similarity(further, each, alone) * each.log_likelihood_gain for each in before
    )


def left_by_formulas(findings: Sequence[Finding]) -> float:
    """The part of the log-likelihood ratio of `findings` that is not evidence: what their formulas may leave."""
    return sum(each.definition.formula_error * each.log_likelihood_gain for each in findings)


def _similarity(one: Candidate, other: Finding, alone: ScoreTest) -> float:
    """r^2 of two effects; 1 if one has impacts, so that its derivative at zero says nothing of it, or if the score test
    lacks one."""
    effects = one.effect, other.definition
    if confusable(*effects) or any(each.impacts for each in effects):
        return 1.0
    known = {one.name, other.effect} <= alone.bases.keys()
    return max(LEAST, alone.similarity(one.name, other.effect) ** 2) if known else 1.0
