"""One step of a diagnosis: which effect explains most of what a model leaves, and does it stand up to unseen data?

screen of all candidates -> quick fits -> full fits and their evidence -> the simplest of the best -> held-out check
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from scipy.stats import chi2

from diagnosis.evidence import LEVEL, SURE, beyond_chance
from diagnosis.explain import explain
from diagnosis.findings import Finding
from diagnosis.fits.finer import finest
from diagnosis.fits.held_out import HeldOutCheck
from diagnosis.fits.look_ahead import foresees
from diagnosis.fits.masked import fits as fits_of_masked
from diagnosis.fits.masked import surprise
from diagnosis.fits.refit import (
    CREEPING,
    FURTHER_FITS,
    FullFit,
    QuickFit,
    full,
    gained,
    possible,
    quick,
    surety,
    with_effect,
)
from diagnosis.gates import Round, Tried, alike, decide, gated, tie
from diagnosis.prepare.candidates import Candidate
from diagnosis.prepare.workspace import Workspace, attached
from diagnosis.score.score_test import Score, Screen, screen
from diagnosis.score.whitened import Whitened
from diagnosis.side_by_side import side_by_side
from diagnosis.trial import tried
from estimators.budget import OutOfTime
from estimators.contract import ParameterEstimate, Status
from estimators.fit.disturbance import disturbances, is_of_disturbance
from estimators.fit.innovations import WIDEST
from estimators.fit.maximum_likelihood import MUCH, Begin, noise_of
from estimators.fit.problem import Problem
from estimators.fit.result import inverse
from estimators.methods.prediction_error import result
from models.effect import Effect
from models.parts import Place
from models.random.disturbance import undriven

Tell = Callable[[str, float], None]

WORTH_A_FIT = LEVEL
"""p-value, of one candidate alone, below which it gets a quick fit."""
FAR = 4.0
"""Inflation of a score above which every candidate gets a quick fit, and twice as many a full one: the innovations are
so far from white that what is missing counts against the very effect that it is."""
CONTENDERS = 6
"""Full fits a step, at most."""
CONTENDING = 0.5
"""Share of the best quick fit's gain with which an effect gets a full one: the noise of both is still another's."""
QUICKLY = 0.5
"""Share of the time that is left which all quick fits of a step together may take."""
IN_PLACE = "effects in place of the disturbance"
"""What is left untried where no time is left for them."""
LATE = 0.7
"""Share of the time that is then left which fits of what the screen does not see may take."""


@dataclass(frozen=True, slots=True)
class Named:
    """An effect that was found, and the `fit` of the model with it."""

    finding: Finding
    fit: FullFit


def look(base: FullFit, workspace: Workspace) -> Screen:
    """What every candidate that the model of `base` does not have would do to its innovations."""

    def attach(group: Sequence[Candidate]) -> Problem:
        return workspace.problem(attached(base.model, group))

    return screen(Whitened.of(base.fit), attach, workspace.others(base.model), workspace.failed)


def surprising(screened: Screen) -> bool:
    """Whether any effect may explain more than chance does.

    It need not do so with all of them looked at: in the model without it the disturbance has grown to what it does,
    beside which it shows less than by the likelihood ratio of its fit, which decides.
    """
    return any(score.p_single < WORTH_A_FIT for score in screened.scores)


def find(
    base: FullFit,
    screened: Screen,
    workspace: Workspace,
    unseen: Collection[str],
    tell: Tell,
    before: Named | None = None,
) -> Named | None:
    """The effect that explains most, in the model; None where none stands up to a full fit and to unseen data.

    `unseen`: effects that get a full fit whatever the screen says. `before`: an effect whose fit is known, and that
    stood up to unseen data.
    """
    known = [before.fit] if before else []
    contenders = _contenders(base, screened, workspace, known, tell)
    # What the screen does not see takes longest, so that it comes last.
    hidden = fits_of_masked(base.model, workspace.within(LATE), unseen, [each.name for each in known])
    fits = _at_one_noise([*contenders, *hidden], base, workspace)
    fitted, asked = _asked(base, fits, screened, {each.name for each in hidden}, workspace)
    check = HeldOutCheck(base, workspace)

    def on_held_out(best: Tried) -> Tried:
        tell(f"checking {best.name} on data that the fit has not seen", 0.95)
        fit = fitted[best.name]
        held_out = before.finding.held_out if before and fit is before.fit else check.of(fit)
        if held_out is None and not workspace.budget.left:
            workspace.leave(f"the held-out check of {best.name}")
        return replace(best, held_out=held_out)

    def in_usual_shape(other: Tried) -> float | None:
        held = tried(partial(_in_usual_shape, fitted[other.name], base, workspace))
        return None if held is None else held - base.log_likelihood

    decided = decide(asked, on_held_out, in_usual_shape)
    workspace.rounds.append(decided)
    if decided.finding is None:
        return None
    best = fitted[decided.named]
    return Named(_finding(best, decided, screened), _from_elsewhere(best, workspace))


def _asked(
    base: FullFit, fits: Sequence[FullFit], screened: Screen, unscreened: Collection[str], workspace: Workspace
) -> tuple[dict[str, FullFit], Round]:
    """All of `fits` in the numbers that decide about them, by the finer formula where that is likelier, and the fits
    that passed the gates, by name. `unscreened`: effects that the screen does not see."""
    tries = max(1, len(screened.scores))
    rows = {each.name: row for each in fits if (row := _gated(each, base, tries, workspace))}
    likely = sorted((each for each in fits if each.name in rows and not rows[each.name].refused), key=_by_evidence)
    best = {each.name: each for each in finest(likely, workspace)}
    names = list(best)
    for each in fits:
        if (fit := best.get(each.name)) is None:
            continue
        row = _in_numbers(fit, base)
        if fit is not each:
            row = replace(row, usual=gained(each, base))
        rows[each.name] = replace(row, p_value=_p_value(fit, base, screened, each.name in unscreened, tries))
    there = tuple(each.name for each in base.model.effects)
    ordered = [*(rows[name] for name in names), *(row for name, row in rows.items() if name not in best)]
    p_value = min((row.p_value for row in ordered if not row.refused), default=1.0)
    return best, Round(there, tries, tuple(ordered), p_value)


def _by_evidence(fitted: FullFit) -> float:
    return -fitted.evidence


def _gated(fitted: FullFit, base: FullFit, tries: int, workspace: Workspace) -> Tried | None:
    """`fitted` in numbers, with the reason of the gate that refuses it; None where these cannot be made."""
    row = tried(partial(_in_numbers, fitted, base), fitted.name, workspace.failed)
    if row is None:
        return None
    if not row.converged:
        workspace.failed[row.name] = "no fit with it ends: it does not settle"
    return gated(row, tries)


def _in_numbers(fitted: FullFit, base: FullFit) -> Tried:
    """What decides about `fitted`, the model of `base` with one effect more. Raises ArithmeticError, LinAlgError."""
    assert fitted.candidate is not None
    gain, parameters = gained(fitted, base)
    converged = fitted.fit.minimum.converged
    return Tried(
        name=fitted.name,
        effect=fitted.candidate.effect,
        log_likelihood=gain,
        parameters=parameters,
        rows=fitted.rows,
        converged=converged,
        inside_bounds=possible(fitted),
        t_ratio=surety(fitted) if converged else math.nan,
        among=fitted.candidate.among if fitted.candidate.picked else 1,
    )


def _p_value(fitted: FullFit, base: FullFit, screened: Screen, unscreened: bool, tries: int) -> float:
    """How likely chance makes one of so many `tries` explain as much as `fitted`, which the screen may not see.

    What the screen saw in a neighbour is this effect's, too, even where the neighbour's own fit leads nowhere.
    """
    assert fitted.candidate is not None
    effect = fitted.candidate.effect
    found = [
        score.p_value
        for score in screened.scores
        if score.candidate.name == fitted.name or alike(score.candidate.effect, effect)
    ]
    found.append(tries * _by_likelihood(fitted, base, screened))
    if unscreened:
        found.append(tries * surprise(base, fitted))
    return min(1.0, *found)


def _in_usual_shape(other: FullFit, base: FullFit, workspace: Workspace) -> float | None:
    """The log likelihood of the model of `base` with the effect of `other` held in its usual shape; None where it has
    none."""
    candidate = other.candidate
    assert candidate is not None
    if not candidate.shapes:
        return None
    own = {name: value for name, value in other.fitted.values.items() if name in candidate.amplitudes}
    usual = base.model.add(candidate.effect, candidate.attached.at).change({**own, **candidate.variants[0]})
    return full(usual, workspace, candidate).log_likelihood


def _from_elsewhere(fitted: FullFit, workspace: Workspace) -> FullFit:
    """`fitted`, or a likelier fit whose noise and disturbance begin at next to nothing: what stood in for the effect
    may have led them to another place. What is looked for next is held against it."""
    task, end = fitted.fit.problem, fitted.fit.end
    if any(each.effect.strikes for each in task.model.effects):
        return fitted  # its minima are as many as its blows, and not of the noise
    its = is_of_disturbance(task.model)
    values = {name: value for name, value in end.values.items() if name not in its}
    begin = Begin(values, noise_of(task, shaken=-WIDEST, white=-WIDEST))
    try:
        again = tried(partial(full, fitted.model, workspace.for_one, fitted.candidate, begin))
    except OutOfTime:
        return fitted
    if again is None or not again.fit.minimum.converged:
        return fitted
    return again if again.log_likelihood > fitted.log_likelihood + CREEPING else fitted


def _by_likelihood(fitted: FullFit, base: FullFit, screened: Screen) -> float:
    """p-value of the likelihood ratio of `fitted` to `base`; 1 where shapes that mean nothing without the effect, or
    innovations that scatter more than chance has it, make it no chi squared."""
    assert fitted.candidate is not None
    if fitted.candidate.shapes:
        return 1.0
    score = next((each for each in screened.scores if each.candidate.name == fitted.name), None)
    gain = (fitted.log_likelihood - base.log_likelihood) / (score.inflation if score else 1.0)
    return float(chi2.sf(2.0 * gain, fitted.count - base.count))


def named_alone(
    base: FullFit, screened: Screen, made: Candidate, parts: Sequence[Finding], workspace: Workspace, finer: bool
) -> Named | None:
    """`made` in the model of `base` in place of `parts`, whose names it may be tied with; None where it does not stand
    up to a full fit and to unseen data. It may have its `finer` formula where these have theirs."""
    fits = []
    for each in workspace.candidates:
        if each is made or each.name in {part.effect for part in parts}:
            model = with_effect(base.model, each, screened.score(each.name).starts[0])
            ended = tried(partial(full, model, workspace, each), each.name, workspace.failed)
            fits += [ended] if ended is not None else []
    fits = finest(fits, workspace) if finer else fits
    best = next((each for each in fits if each.name == made.name), None)
    rows = {each.name: row for each in fits if (row := _gated(each, base, 1, workspace))}
    if best is None or made.name not in rows or rows[made.name].refused:
        return None
    held_out = HeldOutCheck(base, workspace).of(best)
    if held_out is not None and not held_out.stands:
        return None
    p_value = min(screened.score(each.name).p_value for each in fits)
    rows[made.name] = replace(rows[made.name], held_out=held_out)
    there = tuple(each.name for each in base.model.effects)
    decided = tie(Round(there, 1, tuple(rows.values()), p_value, made.name), lambda other: None)
    workspace.rounds.append(decided)
    return Named(_finding(best, decided, screened), best)


def _contenders(
    base: FullFit, screened: Screen, workspace: Workspace, hidden: Sequence[FullFit], tell: Tell
) -> list[FullFit]:
    """`hidden`, and full fits with the effects that explain most.

    Most of what the model of `base` would leave were nothing of it a disturbance, for in its fit the disturbance may
    have grown to what the effect does; and most of what it leaves, as far as that may come to as much.
    """
    known, fits = {each.name for each in hidden}, list(hidden)
    if (without := still(base, workspace)) is not None:
        quicks = tried(partial(_undisturbed, without, base, workspace, partial(_share, tell, 0.0))) or []
        fits += _full_fits(base, quicks, workspace, known, _most, partial(_share, tell, 0.3))
    most = max((each.log_likelihood - base.log_likelihood for each in fits), default=0.0)
    near = replace(screened, scores=tuple(each for each in screened.scores if each.gain >= CONTENDING * most))
    far = any(score.inflation > FAR for score in near.scores if score.p_single < WORTH_A_FIT)
    quicks = _quick_fits(base, near, workspace, partial(_share, tell, 0.6))
    return fits + _full_fits(base, quicks, workspace, known, partial(_with_alike, far), partial(_share, tell, 0.8))


def _at_one_noise(fits: Sequence[FullFit], base: FullFit, workspace: Workspace) -> list[FullFit]:
    """`fits`, of two with one effect the likelier. Those that explain at least CONTENDING of what the likeliest does
    are begun again with its noise; the likelier end of each stays.

    Fits begin with the noise of `base`, which stands in for what is missing, and one may end beside it: of a pendulum
    before which dry friction had been found the viscous friction that is there ended 34 nats below a mode that is not.
    """
    likeliest = {each.name: each for each in sorted(fits, key=lambda each: each.log_likelihood)}
    begun = set[str]()
    while likeliest:
        best = max(likeliest.values(), key=lambda each: each.log_likelihood)
        if best.name in begun:
            break
        begun.add(best.name)
        enough = CONTENDING * (best.log_likelihood - base.log_likelihood)
        near = [each for each in likeliest.values() if each.log_likelihood - base.log_likelihood >= enough > 0.0]
        again = partial(_again, best=best, workspace=workspace)
        ends = side_by_side(again, [each for each in near if each is not best])
        likeliest |= {each.name: each for each in ends if each.log_likelihood > likeliest[each.name].log_likelihood}
    return list(likeliest.values())


def _again(fitted: FullFit, best: FullFit, workspace: Workspace) -> FullFit:
    """`fitted` begun again where it ended, but with the noise and the disturbance of `best`; itself where that fails,
    or no time for it is left."""
    end, other = fitted.fit.end, best.fit.end
    its = is_of_disturbance(fitted.model)
    begin = Begin({**end.values, **{name: other.values[name] for name in its if name in other.values}}, other.noise)
    if len(end.noise) != len(other.noise):
        return fitted
    again = partial(full, fitted.model, workspace.for_one, fitted.candidate, begin)
    try:
        found = tried(again)
    except OutOfTime:
        return fitted
    return found if found is not None and found.fit.minimum.converged else fitted


def _share(tell: Tell, begin: float, text: str, share: float) -> None:
    """`share` of one of the rounds of quick and full fits, which make up to two tenths of a step each."""
    tell(text, min(0.95, begin + 0.2 * share))


def still(base: FullFit, workspace: Workspace) -> FullFit | None:
    """The fit of the model of `base` without its disturbances; None where these explain no more than chance does, or
    where there is no such fit.

    How well their size is known says nothing of that: in a model whose motor is known to four tenths all torques are.
    """
    number = len(disturbances(base.fit))
    if number == 0:
        return None
    try:
        found = tried(partial(full, undriven(base.model), workspace.for_one))
    except OutOfTime:
        workspace.leave(IN_PLACE)
        return None
    there = found is not None and beyond_chance(base.log_likelihood - found.log_likelihood, 2 * number)
    return found if there else None


def _undisturbed(without: FullFit, base: FullFit, workspace: Workspace, tell: Tell) -> list[QuickFit]:
    """Quick fits of the model of `base` from its fit `without` a disturbance; each is to go on with little of one, and
    all other noise as stated. None where no time for it is left."""
    noise = noise_of(base.fit.problem, shaken=-MUCH)
    try:
        found = _quick_fits(without, look(without, workspace), workspace, tell)
    except OutOfTime:
        workspace.leave(IN_PLACE)
        return []
    return [replace(each, end=replace(each.end, noise=noise)) for each in found]


def _quick_fits(base: FullFit, screened: Screen, workspace: Workspace, tell: Tell) -> list[QuickFit]:
    """Of the candidates that are worth one by what the screen of `base` says."""
    worth = [score for score in screened.scores if score.p_single < WORTH_A_FIT]
    if any(score.inflation > FAR for score in worth):
        worth = list(screened.scores)
    # Where the model alone is far off, a line from there may miss what would do the same as the surest.
    near = worth[0].candidate.effect.confused_with if worth else ()
    worth += [score for score in screened.scores if score.candidate.name in near and score not in worth]

    quickly = workspace.within(QUICKLY)

    def prepare(number: int, score: Score) -> bool:
        title, share = score.candidate.effect.title, number / len(worth)
        model = with_effect(base.model, score.candidate, score.starts[0])
        compiled = partial(quickly.problem, model, lambda text: tell(f"{text} with {title}", share))
        try:
            return tried(compiled, score.candidate.name, workspace.failed) is not None
        except OutOfTime:
            workspace.leave(score.candidate.name)
            return False

    # Compiled one after the other, where that was not done yet.
    worth = [score for number, score in enumerate(worth) if prepare(number, score)]

    def quickly_fitted(score: Score) -> QuickFit | None:
        try:
            ended = partial(_ended, base, score, quickly.for_one)
            return tried(ended, score.candidate.name, workspace.failed)
        except OutOfTime:
            workspace.leave(score.candidate.name)
            return None

    quicks: list[QuickFit] = []
    for number, each in enumerate(side_by_side(quickly_fitted, worth), start=1):
        quicks += [each] if each is not None else []
        tell("tried" + (f" {each.candidate.effect.title}" if each else ""), number / len(worth))
    return [each for each in quicks if np.isfinite(each.gain) and each.gain > 0.0]


def _ended(base: FullFit, score: Score, workspace: Workspace) -> QuickFit:
    """A quick fit. Raises ArithmeticError where the model runs away from every start of it."""
    found = quick(base.fit, base.model, score, workspace)
    if not math.isfinite(found.gain):
        raise ArithmeticError("the model runs away from every start")
    return found


def _full_fits(
    base: FullFit,
    quicks: Sequence[QuickFit],
    workspace: Workspace,
    hidden: Collection[str],
    most: Callable[[Sequence[QuickFit]], list[QuickFit]],
    tell: Tell,
) -> list[FullFit]:
    """Of those that explain the `most` of `quicks`, but for `hidden`, which have theirs. One that explains by what no
    predictor knows is no measure of what is most.

    Each begins where its quick fit ended. A fit that ends less likely than the model alone
    began with a noise that this had, and the effect takes away: it is begun again with the noise that is stated. Where
    friction was missing the gyro had had e^-6 of its noise, and the fit with the friction ended 100,000 too low.
    """
    left = sorted(quicks, key=lambda each: -each.gain)

    def fitted(ended: QuickFit) -> FullFit | None:
        found = _fitted(base, ended, ended.end, workspace)
        if found is not None and found.log_likelihood > base.log_likelihood - CREEPING:
            return found
        again = _fitted(base, ended, replace(ended.end, noise=stated), workspace)
        return max((each for each in (found, again) if each), key=lambda each: each.log_likelihood, default=None)

    stated, found = np.zeros(len(base.fit.end.noise)), dict[str, FullFit | None]()
    while True:
        chosen = [each for each in most(left) if each.candidate.name not in {*hidden, *found}]
        if not chosen:
            return [each for each in found.values() if each is not None]
        for number, (each, fit) in enumerate(zip(chosen, side_by_side(fitted, chosen), strict=True), start=1):
            tell(f"fitted {each.candidate.effect.title}", number / len(chosen))
            if fit is not None and tried(partial(foresees, fit.fit, base.fit)):
                left = [one for one in left if one is not each]
            else:
                found[each.candidate.name] = fit


def _fitted(base: FullFit, quick: QuickFit, end: Begin, workspace: Workspace) -> FullFit | None:
    """The full fit of the model with the effect of `quick` from `end` on; None where it fails or the time is over."""
    candidate = quick.candidate
    model = with_effect(base.model, candidate, quick.values)
    fit = partial(full, model, workspace.for_one, candidate, end, longer=FURTHER_FITS)
    try:
        return tried(fit, candidate.name, workspace.failed)
    except OutOfTime:
        workspace.leave(candidate.name)
        return None


def _most(fits: Sequence[QuickFit]) -> list[QuickFit]:
    """Those of `fits`, the most gaining first, that explain most."""
    return [each for each in fits[:CONTENDERS] if each.gain >= CONTENDING * fits[0].gain]


def _with_alike(far: bool, fits: Sequence[QuickFit]) -> list[QuickFit]:
    """Those that explain most, and what does the same as one of these: at the noise of the model alone, in which the
    disturbance stands in for the effect, it may gain a fifth, as a sensor that is mounted askew of what a constant
    torque does."""
    most = [each.candidate.effect for each in fits if each.gain >= CONTENDING * fits[0].gain]
    near = [each for each in fits if each.candidate.effect in most or _like_any(each, most)]
    return near[: CONTENDERS * (2 if far else 1)]


def _like_any(fitted: QuickFit, effects: Sequence[Effect]) -> bool:
    return any(alike(fitted.candidate.effect, each) for each in effects)


def _finding(best: FullFit, decided: Round, screened: Screen) -> Finding:
    """What was `decided`, of which `best` is the fit."""
    row, p_value = decided.finding, decided.p_value
    assert row is not None
    assert best.candidate is not None
    odds = {each.name: float(np.exp(np.clip(each.evidence - row.evidence, -700.0, 0.0))) for each in decided.passed}
    # The least odds that "none" can have at this p-value, whatever the prior of the size: Sellke, Bayarri, Berger,
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
        screen=screened,
    )
    return reworded(finding)


def retold(finding: Finding, fitted: FullFit) -> Finding:
    """`finding` with its parameters as `fitted` has them, which other effects may have moved."""
    return reworded(replace(finding, parameters=sizes(finding.effect, fitted)))


def reworded(finding: Finding) -> Finding:
    """`finding` with an explanation that has its parameters."""
    screened = finding.screen
    assert screened is not None
    return replace(finding, explanation=explain(finding, screened.score(finding.effect)))


def sizes(effect: str, fitted: FullFit) -> dict[str, ParameterEstimate]:
    """The parameters of `effect`, by name.

    A size that data alone do not tell, because another parameter does the same, is told by what was known of that one:
    readings that are late from commands that are early, by the clocks that both have.
    """
    told = result(fitted.fit, 0.0).parameters
    amplitudes = next(each.amplitudes for each in fitted.model.effects if each.name == effect)
    deviations = np.sqrt(np.diag(inverse(fitted.fit.minimum.information)))
    found = {}
    for place, parameter in enumerate(fitted.fit.problem.parameters):
        name = parameter.name
        if not name.startswith(f"{effect}."):
            continue
        found[name] = told[name]
        value, std = float(fitted.fit.minimum.common[place]), float(deviations[place])
        if name in amplitudes and told[name].value is None and abs(value) > SURE * std:
            reason = f"told by what was known before: {told[name].reason}"
            found[name] = replace(told[name], value=value, std=std, status=Status.OK, reason=reason)
    return found


def unseen_at_zero(workspace: Workspace) -> list[str]:
    """Effects on sensors whose amplitude has starts of its own: near zero the record may ask for less of them."""
    return [
        each.effect.name
        for each in workspace.candidates
        if each.effect.place is Place.SENSOR and any(p.amplitude and p.starts for p in each.effect.parameters)
    ]
