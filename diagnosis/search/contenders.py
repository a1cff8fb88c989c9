"""Which effects get a fit, and the fits: of all candidates those that may explain most of a model's lack of fit.

score of all candidates -> quick fits of the plausible ones -> full fits of those that explain most -> all at one noise

If the record requires a disturbance, both are first made in the model without one: in the fit of the model alone it may
have grown to imitate an effect.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from upright.diagnosis.evidence import LEVEL, beyond_chance
from upright.diagnosis.fits import confounded
from upright.diagnosis.fits.look_ahead import looks_ahead
from upright.diagnosis.fits.refit import (
    CREEPING,
    FURTHER_FITS,
    FullFit,
    QuickFit,
    as_evident,
    full,
    quick,
    with_effect,
)
from upright.diagnosis.gates import confusable
from upright.diagnosis.prepare.candidates import Candidate
from upright.diagnosis.prepare.workspace import Workspace, attached
from upright.diagnosis.score.score_test import Score, ScoreTest, score_test
from upright.diagnosis.score.whitened import Whitened
from upright.diagnosis.search.explanation import Progress, no_progress
from upright.diagnosis.side_by_side import side_by_side
from upright.diagnosis.trial import tried
from upright.estimators.fit.maximum_likelihood import MUCH, Begin, noise_of
from upright.estimators.fit.problem import Problem
from upright.estimators.fit.random.disturbance import disturbances, is_of_disturbance
from upright.models.effect import Effect
from upright.models.parts import Place
from upright.models.random.disturbance import with_zero_disturbances

WORTH_A_FIT = LEVEL
"""p-value, of one candidate alone, below which it gets a quick fit."""
FAR = 4.0
"""Inflation of a score above which every candidate gets a quick fit, and twice as many a full one: the innovations are
so far from white that the missing effect itself counts as noise against its own score."""
CONTENDERS = 6
"""Full fits per step, at most."""
CONTENDING = 0.5
"""Share of the best quick fit's log-likelihood ratio above which an effect gets a full fit: the noise of both is not
yet their own."""
QUICKLY = 0.5
"""Share of the remaining time that all quick fits of a step together may take."""
IN_PLACE = "effects in place of the disturbance"
"""Name in `untried` of the fits without a disturbance if no time is left for them."""


def look(base: FullFit, workspace: Workspace) -> ScoreTest:
    """The score test of every candidate that the model of `base` does not have, on its innovations."""

    def attach(group: Sequence[Candidate]) -> Problem:
        return workspace.problem(attached(base.model, group))

    return score_test(Whitened.of(base.fit), attach, workspace.others(base.model), workspace.failed)


def contenders(
    base: FullFit, scored: ScoreTest, workspace: Workspace, hidden: Sequence[FullFit], progress: Progress
) -> list[FullFit]:
    """`hidden`, and full fits with the effects that explain most.

    First those that explain most of what the model of `base` leaves without a disturbance, since in its fit the
    disturbance may have grown to imitate the effect; then those that explain most of what it leaves with one, if their
    score predicts at least CONTENDING of the former's log-likelihood ratio.
    """
    known, in_place = {each.name for each in hidden}, list[FullFit]()
    if (without := undisturbed_fit(base, workspace)) is not None:
        quicks = _undisturbed(without, base, workspace, partial(_share, progress, 0.0))
        in_place = _full_fits(base, quicks, workspace, known, _most, partial(_share, progress, 0.3))
    most = max((each.log_likelihood - base.log_likelihood for each in in_place), default=0.0)
    near = replace(scored, scores=tuple(each for each in scored.scores if each.gain >= CONTENDING * most))
    far = any(score.inflation > FAR for score in near.scores if score.p_single < WORTH_A_FIT)
    quicks = _quick_fits(base, near, workspace, partial(_share, progress, 0.6))
    beside = _full_fits(base, quicks, workspace, known, partial(_with_confusable, far), partial(_share, progress, 0.8))
    return [*hidden, *in_place, *beside]


def each_fitted(
    base: FullFit, scored: ScoreTest, workspace: Workspace, progress: Progress = no_progress
) -> dict[str, FullFit]:
    """The likeliest fit with each of the candidates of `workspace`, whatever its score, by name; without those whose
    fits all fail.

    Fitted as a diagnosis fits its contenders. A candidate whose quick fit leads nowhere starts with next to no
    amplitude.
    """
    quicks = _quick_fits(base, scored, workspace, progress, every=True)
    found = _full_fits(base, quicks, workspace, (), list, progress)
    if (without := undisturbed_fit(base, workspace)) is not None:
        in_place = _undisturbed(without, base, workspace, progress, every=True)
        found += _full_fits(base, in_place, workspace, (), list, progress)
    found += confounded.fits(base, workspace, flat_at_zero(workspace))
    there = {each.name for each in found}
    for each in workspace.others(base.model):
        if each.name not in there:
            start = {**dict.fromkeys(each.amplitudes, 0.0), **each.variants[0]}
            end = replace(base.fit.end, values={**base.fit.end.values, **start})
            one = partial(full, with_effect(base.model, each, start), workspace.for_one, each, end)
            fit = workspace.in_time(one, each.name, failed=True)
            found += [fit] if fit is not None else []
    return {each.name: each for each in at_one_noise(found, base, workspace)}


def flat_at_zero(workspace: Workspace) -> list[str]:
    """Effects on sensors whose amplitude has starts of its own: near zero the derivative may have the wrong sign."""
    return [
        each.effect.name
        for each in workspace.candidates
        if each.effect.place is Place.SENSOR and any(p.amplitude and p.starts for p in each.effect.parameters)
    ]


def at_one_noise(fits: Sequence[FullFit], base: FullFit, workspace: Workspace) -> list[FullFit]:
    """`fits`, of two with one effect the likelier. Those that explain at least CONTENDING of what the likeliest does
    are restarted with its noise; the likelier end of each is kept.

    Fits start with the noise of `base`, which accounts for what is missing, and one may miss its optimum: in a pendulum
    in which dry friction had been found, the true viscous friction ended 34 nats below a mode that does not exist.
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
    """`fitted` restarted from its end, but with the noise and the disturbance of `best`; unchanged if that fails, or no
    time is left for it."""
    end, other = fitted.fit.end, best.fit.end
    its = is_of_disturbance(fitted.model)
    begin = Begin({**end.values, **{name: other.values[name] for name in its if name in other.values}}, other.noise)
    if len(end.noise) != len(other.noise):
        return fitted
    found = workspace.in_time(partial(as_evident, fitted, fitted.model, workspace.for_one, fitted.candidate, begin))
    return found if found is not None and found.fit.minimum.converged else fitted


def _share(progress: Progress, begin: float, text: str, share: float) -> None:
    """`share` of one of the rounds of quick and full fits, which make up to two tenths of a step each."""
    progress(text, min(0.95, begin + 0.2 * share))


def undisturbed_fit(base: FullFit, workspace: Workspace) -> FullFit | None:
    """The fit of the model of `base` without its disturbances; None if these explain no more than chance does, or if
    there is no such fit.

    The standard deviation of their RMS cannot decide that: if the motor constant is known to 40 % only, so is every
    torque. The fit only serves to look for effects, so it is not exact.
    """
    number = len(disturbances(base.fit))
    if number == 0:
        return None
    one = partial(full, with_zero_disturbances(base.model), workspace.for_one, enough=CREEPING)
    found = workspace.in_time(one, IN_PLACE)
    there = found is not None and beyond_chance(base.log_likelihood - found.log_likelihood, 2 * number)
    return found if there else None


def _undisturbed(
    without: FullFit, base: FullFit, workspace: Workspace, progress: Progress, every: bool = False
) -> list[QuickFit]:
    """Quick fits of the model of `base` from its fit `without` a disturbance, as of `_quick_fits`; each goes on with a
    small disturbance, and all other noise as stated. Empty if no time is left for it."""
    scored = workspace.in_time(partial(look, without, workspace), IN_PLACE)
    found = _quick_fits(without, scored, workspace, progress, every) if scored else []
    noise = noise_of(base.fit.problem, shaken=-MUCH)
    return [replace(each, end=replace(each.end, noise=noise)) for each in found]


def _quick_fits(
    base: FullFit, scored: ScoreTest, workspace: Workspace, progress: Progress, every: bool = False
) -> list[QuickFit]:
    """Quick fits of the candidates that the score test of `base` suggests, or of every one."""
    chosen = [score for score in scored.scores if every or score.p_single < WORTH_A_FIT]
    if any(score.inflation > FAR for score in chosen):
        chosen = list(scored.scores)
    # If the model alone is far off, its linearisation may miss effects confusable with the most significant one.
    near = chosen[0].candidate.effect.confused_with if chosen else ()
    chosen += [score for score in scored.scores if score.candidate.name in near and score not in chosen]
    if not every:
        # From the model alone, a fit with colliding parts mostly leads nowhere (diagnosis.fits.confounded).
        chosen = [score for score in chosen if not score.candidate.effect.impacts]

    quickly, most = workspace.within(QUICKLY), max((score.gain for score in scored.scores), default=0.0)

    def prepare(number: int, score: Score) -> bool:
        title, share = score.candidate.effect.title, number / len(chosen)
        model = with_effect(base.model, score.candidate, score.starts[0])
        compiled = partial(quickly.problem, model, lambda text: progress(f"{text} with {title}", share))
        return quickly.in_time(compiled, score.candidate.name, failed=True) is not None

    # Compiled one after the other, unless that was done before.
    chosen = [score for number, score in enumerate(chosen) if prepare(number, score)]

    def quickly_fitted(score: Score) -> QuickFit | None:
        return quickly.in_time(partial(_ended, base, score, quickly.for_one, most), score.candidate.name, failed=True)

    quicks: list[QuickFit] = []
    for number, each in enumerate(side_by_side(quickly_fitted, chosen), start=1):
        quicks += [each] if each is not None else []
        progress("tried" + (f" {each.candidate.effect.title}" if each else ""), number / len(chosen))
    return [each for each in quicks if np.isfinite(each.gain) and each.gain > 0.0]


def _ended(base: FullFit, score: Score, workspace: Workspace, most: float) -> QuickFit:
    """A quick fit. Raises ArithmeticError if the model diverges from every start."""
    found = quick(base.fit, base.model, score, workspace, most)
    if not math.isfinite(found.gain):
        raise ArithmeticError("the model diverges from every start")
    return found


def _full_fits(
    base: FullFit,
    quicks: Sequence[QuickFit],
    workspace: Workspace,
    hidden: Collection[str],
    most: Callable[[Sequence[QuickFit]], list[QuickFit]],
    progress: Progress,
) -> list[FullFit]:
    """Full fits of those of `quicks` that explain the `most`, except `hidden`, which have theirs. Non-causal fits are
    excluded, and are no measure of what is most.

    Each starts where its quick fit ended. If it ends less likely than the model alone, it started with the noise of the
    model alone, which had accounted for the effect: it is restarted with the stated noise. In a case of missing
    friction the gyro had had e^-6 of its noise, and the fit with the friction ended 100,000 too low.
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
            progress(f"fitted {each.candidate.effect.title}", number / len(chosen))
            if fit is not None and tried(partial(looks_ahead, fit.fit, base.fit)):
                left = [one for one in left if one is not each]
            else:
                found[each.candidate.name] = fit


def _fitted(base: FullFit, quick: QuickFit, end: Begin, workspace: Workspace) -> FullFit | None:
    """The full fit of the model with the effect of `quick` from `end` on; None if it fails or time runs out."""
    candidate = quick.candidate
    model = with_effect(base.model, candidate, quick.values)
    fit = partial(full, model, workspace.for_one, candidate, end, longer=FURTHER_FITS)
    return workspace.in_time(fit, candidate.name, failed=True)


def _most(fits: Sequence[QuickFit]) -> list[QuickFit]:
    """Those of `fits`, sorted by log-likelihood ratio, that explain most."""
    return [each for each in fits[:CONTENDERS] if each.gain >= CONTENDING * fits[0].gain]


def _with_confusable(far: bool, fits: Sequence[QuickFit]) -> list[QuickFit]:
    """Those that explain most, and effects confusable with one of these: at the noise of the model alone, in which the
    disturbance imitates the effect, their log-likelihood ratio may be a fifth, as for a sensor that is mounted askew
    compared with a constant torque."""
    most = [each.candidate.effect for each in fits if each.gain >= CONTENDING * fits[0].gain]
    near = [each for each in fits if each.candidate.effect in most or _confusable_with_any(each, most)]
    return near[: CONTENDERS * (2 if far else 1)]


def _confusable_with_any(fitted: QuickFit, effects: Sequence[Effect]) -> bool:
    return any(confusable(fitted.candidate.effect, each) for each in effects)
