"""One step of the search: which effect explains most of a model's lack of fit, and does it hold on held-out data?

score test of all candidates -> quick fits -> full fits and their evidence -> the simplest of the best -> held-out check
"""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from upright.diagnosis.evidence import SIGNIFICANT, by_chance
from upright.diagnosis.explain import explain
from upright.diagnosis.findings import Finding
from upright.diagnosis.fits.confounded import fits as fits_of_confounded
from upright.diagnosis.fits.confounded import surprise
from upright.diagnosis.fits.finer import finest
from upright.diagnosis.fits.refit import (
    CREEPING,
    FullFit,
    as_evident,
    full,
    inside_bounds,
    log_ratio,
    t_ratio,
    with_effect,
)
from upright.diagnosis.gates import Round, Tried, confusable, decide, gated, tie
from upright.diagnosis.prepare.candidates import Candidate
from upright.diagnosis.prepare.workspace import Workspace
from upright.diagnosis.score.score_test import ScoreTest
from upright.diagnosis.search.contenders import WORTH_A_FIT, at_one_noise, contenders
from upright.diagnosis.search.explanation import Search
from upright.diagnosis.search.further import left_for
from upright.diagnosis.search.held_out import held_out
from upright.diagnosis.trial import tried
from upright.estimators.contract import ParameterEstimate, Status
from upright.estimators.fit.innovations import WIDEST
from upright.estimators.fit.maximum_likelihood import Begin, noise_of
from upright.estimators.fit.random.disturbance import is_of_disturbance
from upright.estimators.fit.result import inverse
from upright.estimators.methods.prediction_error import result

LATE = 0.7
"""Share of the time then left for fits of effects that the score test does not see."""


@dataclass(frozen=True, slots=True)
class Named:
    """An effect that was found, and the `fit` of the model with it."""

    finding: Finding
    fit: FullFit


@dataclass(frozen=True, slots=True)
class Covered:
    """An effect that explains no more than the formulas of those found before may leave: too little for a name, but
    the deviation that the `fit` with it covers is known."""

    fit: FullFit


def may_be_significant(scored: ScoreTest) -> bool:
    """Whether any effect may explain more than chance does.

    No correction for the number of effects is required here: in the model without the effect the disturbance has grown
    to imitate it, so the score is smaller than the likelihood ratio of its fit, which decides.
    """
    return any(score.p_single < WORTH_A_FIT for score in scored.scores)


def find(base: FullFit, scored: ScoreTest, how: Search, before: Named | None = None) -> Named | Covered | None:
    """The effect that explains most, in the model, or the fit with it if formulas may leave as much; None if none
    passes the gates and the check on held-out data.

    `before`: an effect whose fit is known, and that passed the check on held-out data.
    """
    workspace, progress = how.workspace, how.progress
    known = [before.fit] if before else []
    fitted_first = contenders(base, scored, workspace, known, progress)
    # Effects that the score test does not see take longest, so they come last.
    hidden = fits_of_confounded(base, workspace.within(LATE), how.confounded, [each.name for each in known])
    fits = at_one_noise([*fitted_first, *hidden], base, workspace)
    fitted, undecided = _undecided(base, fits, scored, {each.name for each in hidden}, how)

    def on_held_out(best: Tried) -> Tried:
        progress(f"checking {best.name} on held-out data", 0.95)
        fit = fitted[best.name]
        checked = before.finding.held_out if before and fit is before.fit else held_out(fit, base, workspace)
        if checked is None and not workspace.budget.left:
            workspace.leave(f"the held-out check of {best.name}")
        return replace(best, held_out=checked)

    def in_usual_shape(other: Tried) -> float | None:
        held = tried(partial(_in_usual_shape, fitted[other.name], base, workspace))
        return None if held is None else held - base.log_likelihood

    decided = decide(undecided, on_held_out, in_usual_shape)
    workspace.rounds.append(decided)
    if decided.covered:
        return Covered(fitted[decided.covered])
    if decided.finding is None:
        return None
    best = fitted[decided.named]
    return Named(_finding(best, decided, scored), _from_elsewhere(best, workspace))


def _undecided(
    base: FullFit, fits: Sequence[FullFit], scored: ScoreTest, unscored: Collection[str], how: Search
) -> tuple[dict[str, FullFit], Round]:
    """All of `fits` in the numbers that decide about them, with the finer formula if that is likelier, and the fits
    that passed the gates, by name. `unscored`: effects that the score test does not see."""
    workspace, tries = how.workspace, max(1, len(scored.scores))
    rows = {each.name: row for each in fits if (row := _gated(each, base, tries, workspace))}
    likely = sorted((each for each in fits if each.name in rows and not rows[each.name].refused), key=_by_evidence)
    best = {each.name: each for each in finest(likely, workspace)}
    names = list(best)
    for each in fits:
        if (fit := best.get(each.name)) is None:
            continue
        row = _in_numbers(fit, base)
        if fit is not each:
            row = replace(row, usual=log_ratio(each, base))
        assert each.candidate is not None
        left = how.of_impacts + left_for(each.candidate, how.found, how.alone)
        rows[each.name] = replace(row, p_value=_p_value(fit, base, scored, each.name in unscored, tries), left=left)
    there = tuple(each.name for each in base.model.effects)
    ordered = [*(rows[name] for name in names), *(row for name, row in rows.items() if name not in best)]
    p_value = min((row.p_value for row in ordered if not row.refused), default=1.0)
    return best, Round(there, tries, tuple(ordered), p_value)


def _by_evidence(fitted: FullFit) -> float:
    return -fitted.evidence


def _gated(fitted: FullFit, base: FullFit, tries: int, workspace: Workspace) -> Tried | None:
    """`fitted` in numbers, with the reason of the gate that rejects it; None if these cannot be computed."""
    row = tried(partial(_in_numbers, fitted, base), fitted.name, workspace.failed)
    if row is None:
        return None
    if not row.converged:
        workspace.failed[row.name] = "its fit fails: it does not converge"
    return gated(row, tries)


def _in_numbers(fitted: FullFit, base: FullFit) -> Tried:
    """The numbers that decide about `fitted`, the model of `base` with one more effect. Raises ArithmeticError,
    LinAlgError."""
    assert fitted.candidate is not None
    gain, parameters = log_ratio(fitted, base)
    converged = fitted.fit.minimum.converged
    return Tried(
        name=fitted.name,
        effect=fitted.candidate.effect,
        log_likelihood=gain,
        parameters=parameters,
        rows=fitted.rows,
        converged=converged,
        inside_bounds=inside_bounds(fitted),
        t_ratio=t_ratio(fitted, fitted.name) if converged else math.nan,
        among=fitted.candidate.among if fitted.candidate.picked else 1,
    )


def _p_value(fitted: FullFit, base: FullFit, scored: ScoreTest, unscored: bool, tries: int) -> float:
    """Probability that by chance one of `tries` effects explains as much as `fitted`, which the score test may not see.

    The score of a confusable effect counts for this one, too, even if the fit of that effect leads nowhere.
    """
    assert fitted.candidate is not None
    effect = fitted.candidate.effect
    found = [
        score.p_value
        for score in scored.scores
        if score.candidate.name == fitted.name or confusable(score.candidate.effect, effect)
    ]
    found.append(tries * _by_likelihood(fitted, base, scored))
    if unscored:
        found.append(tries * surprise(base, fitted))
    return min(1.0, *found)


def _in_usual_shape(other: FullFit, base: FullFit, workspace: Workspace) -> float | None:
    """The log-likelihood of the model of `base` with the effect of `other` held in its usual shape; None if it has
    none."""
    candidate = other.candidate
    assert candidate is not None
    if not candidate.shapes:
        return None
    own = {name: value for name, value in other.fitted.values.items() if name in candidate.amplitudes}
    usual = base.model.add(candidate.effect, candidate.attached.at).change({**own, **candidate.variants[0]})
    return full(usual, workspace, candidate).log_likelihood


def _from_elsewhere(fitted: FullFit, workspace: Workspace) -> FullFit:
    """`fitted`, or a likelier fit that starts with next to no noise and disturbance: what had accounted for the effect
    may have led them to another minimum. The next effects are compared with this fit."""
    task, end = fitted.fit.problem, fitted.fit.end
    if any(each.effect.impacts for each in task.model.effects):
        return fitted  # its minima are as many as its impacts, and not of the noise
    its = is_of_disturbance(task.model)
    values = {name: value for name, value in end.values.items() if name not in its}
    begin = Begin(values, noise_of(task, shaken=-WIDEST, white=-WIDEST))
    again = workspace.in_time(partial(as_evident, fitted, fitted.model, workspace.for_one, fitted.candidate, begin))
    if again is None or not again.fit.minimum.converged:
        return fitted
    return again if again.log_likelihood > fitted.log_likelihood + CREEPING else fitted


def _by_likelihood(fitted: FullFit, base: FullFit, scored: ScoreTest) -> float:
    """p-value of the likelihood ratio of `fitted` to `base`, corrected for innovations that scatter more than white
    ones."""
    assert fitted.candidate is not None
    score = next((each for each in scored.scores if each.candidate.name == fitted.name), None)
    gain = (fitted.log_likelihood - base.log_likelihood) / (score.inflation if score else 1.0)
    return by_chance(gain, fitted.count - base.count, len(fitted.candidate.shapes), fitted.rows)


def named_alone(
    base: FullFit, scored: ScoreTest, made: Candidate, parts: Sequence[Finding], workspace: Workspace, finer: bool
) -> Named | None:
    """`made` in the model of `base` in place of `parts`, with whose names it may be tied; None if it does not pass the
    gates and the check on held-out data. It may have its `finer` formula if these have theirs."""
    fits = []
    for each in workspace.candidates:
        if each is made or each.name in {part.effect for part in parts}:
            model = with_effect(base.model, each, scored.score(each.name).starts[0])
            ended = tried(partial(full, model, workspace, each), each.name, workspace.failed)
            fits += [ended] if ended is not None else []
    fits = finest(fits, workspace) if finer else fits
    best = next((each for each in fits if each.name == made.name), None)
    rows = {each.name: row for each in fits if (row := _gated(each, base, 1, workspace))}
    if best is None or made.name not in rows or rows[made.name].refused:
        return None
    checked = held_out(best, base, workspace)
    if checked is not None and not checked.stands:
        return None
    p_value = min(scored.score(each.name).p_value for each in fits)
    rows[made.name] = replace(rows[made.name], held_out=checked)
    there = tuple(each.name for each in base.model.effects)
    decided = tie(Round(there, 1, tuple(rows.values()), p_value, made.name, given=True), lambda other: None)
    workspace.rounds.append(decided)
    return Named(_finding(best, decided, scored), best)


def _finding(best: FullFit, decided: Round, scored: ScoreTest) -> Finding:
    """The finding that was `decided`, of which `best` is the fit."""
    row, p_value = decided.finding, decided.p_value
    assert row is not None
    assert best.candidate is not None
    odds = {each.name: float(np.exp(np.clip(each.evidence - row.evidence, -700.0, 0.0))) for each in decided.passed}
    # The least odds that "none" can have at this p-value, whatever the prior of the amplitude: Sellke, Bayarri, Berger,
    # "Calibration of p values for testing precise null hypotheses" (2001).
    none = -math.e * p_value * math.log(max(p_value, 1e-300))
    finding = Finding(
        effect=best.name,
        family=best.candidate.effect.family.value,
        parameters=sizes(best.name, best),
        probability=1.0 / (sum(odds.values()) + none),
        p_value=p_value,
        tied_with=decided.tied_with,
        explanation="",
        log_likelihood_gain=row.log_likelihood,
        held_out=row.held_out,
        odds=odds,
        gains={each.name: each.log_likelihood / row.log_likelihood for each in decided.passed},
        score_test=scored,
    )
    return with_explanation(finding)


def with_estimates(finding: Finding, fitted: FullFit) -> Finding:
    """`finding` with its parameters as estimated in `fitted`, which other effects may have changed."""
    return with_explanation(replace(finding, parameters=sizes(finding.effect, fitted)))


def with_explanation(finding: Finding) -> Finding:
    """`finding` with an explanation that has its parameters."""
    scored = finding.score_test
    assert scored is not None
    return replace(finding, explanation=explain(finding, scored.score(finding.effect)))


def sizes(effect: str, fitted: FullFit) -> dict[str, ParameterEstimate]:
    """The parameters of `effect`, by name.

    An amplitude that data alone do not determine, because it is confounded with another parameter, is determined by the
    prior of that one: readings that are late from commands that are early, by the clocks that both have.
    """
    estimates = result(fitted.fit, 0.0).parameters
    amplitudes = next(each.amplitudes for each in fitted.model.effects if each.name == effect)
    deviations = np.sqrt(np.diag(inverse(fitted.fit.minimum.information)))
    found = {}
    for place, parameter in enumerate(fitted.fit.problem.parameters):
        name = parameter.name
        if not name.startswith(f"{effect}."):
            continue
        found[name] = estimates[name]
        value, std = float(fitted.fit.minimum.common[place]), float(deviations[place])
        if name in amplitudes and estimates[name].value is None and abs(value) > SIGNIFICANT * std:
            reason = f"determined by prior knowledge: {estimates[name].reason}"
            found[name] = replace(estimates[name], value=value, std=std, status=Status.OK, reason=reason)
    return found
