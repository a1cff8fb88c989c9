"""The search for what a model lacks: effect after effect, each with the others and with random parts in the model.

    score all effects that the model does not have
    -> one more effect (search.one_more), or two of which neither shows alone
    -> the neighbours of the findings so far (search.neighbours): another in place of each, two of one, one of two
    -> again, until nothing passes

Then random parts are searched for with the effects in the model, and the effects again with each of these, as long as
the evidence of all of them together rises. Effects that lead by more than the random part explains are kept (`_kept`).
A random part is not a finding about the vehicle.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

from upright.diagnosis.evidence import beyond_chance, likelier
from upright.diagnosis.findings import Finding, MadeOf
from upright.diagnosis.fits.random_parts import RANDOM, absorbed, expected_log_ratio
from upright.diagnosis.fits.refit import (
    FURTHER_FITS,
    FullFit,
    exactly,
    full,
    log_ratio,
    remembered,
    settled,
    with_effect,
)
from upright.diagnosis.prepare.workspace import Workspace
from upright.diagnosis.score.score_test import ScoreTest
from upright.diagnosis.search.contenders import flat_at_zero, look, undisturbed_fit
from upright.diagnosis.search.explanation import NOTHING_SCORED, Explanation, Search
from upright.diagnosis.search.neighbours import add_two, one_by_one, parts_of, revised
from upright.diagnosis.search.one_more import Named, find, may_be_significant, sizes, with_estimates
from upright.diagnosis.trial import FAILURES, tried

HALF = 0.5
"""Share of the time for each of two searches: without a random part that seems to explain most, and with it."""
ONCE = 0.75
"""Share of the progress bar for work that may have to be repeated; for the bar alone."""


@dataclass(frozen=True, slots=True)
class Found:
    """The result of a search.

    `base`: the fit of the model alone; `bare`: that without its effects whose parts collide; `fits` with the first of
    `findings`, with the first two, and so on; `score_tests` before each and after the last. `last`: the fit of all that
    was found, which may have one effect more than is named: it explains too little for a name, but the deviation that
    it covers does not count as unknown.
    """

    base: FullFit
    bare: FullFit
    findings: tuple[Finding, ...]
    fits: tuple[FullFit, ...]
    score_tests: tuple[ScoreTest, ...]
    last: FullFit


def search(base: FullFit, how: Search, before: Explanation | None = None) -> Found:
    """The effects that `base`, the fit of a model alone, lacks, with the random parts that the record requires.

    `before`: the explanation of these samples and others; the search starts from it if it holds here.
    """
    workspace = how.workspace
    held = workspace.in_time(partial(_held, base, before, how), RANDOM) if before else None
    base, known = held or (base, Explanation((), base))
    # If a random part seems to explain more than any effect, the search without it leaves it half of the time.
    alone = _alone(base, workspace)
    hurried = not known.findings and _outdone(base, alone)
    first = replace(how, workspace=workspace.within(HALF), alone=alone) if hurried else replace(how, alone=alone)
    begun = ONCE
    found = _effects(base, known, first.part(0.0, begun))
    while True:
        wider = workspace.in_time(partial(absorbed, found.base, found.last, workspace), RANDOM)
        if wider is None:
            return found
        own = replace(how, workspace=replace(workspace, untried=[]), alone=_alone(wider, workspace))
        own = own.part(begun, ONCE * (1.0 - begun))
        kept = workspace.in_time(partial(_kept, found, wider, workspace), RANDOM)
        if kept is None:
            return found
        again = _effects(wider, kept, own)
        begun += ONCE * (1.0 - begun)
        for each in own.workspace.untried:
            workspace.leave(each)
        cut_short = own.workspace.untried and not again.findings
        if (found.findings and cut_short) or again.last.evidence <= found.last.evidence:
            return found
        found = again


def _effects(base: FullFit, known: Explanation, how: Search) -> Found:
    """Effect after effect beside the `known` ones, at most as many as `how` allows."""
    workspace, most = how.workspace, how.most
    bare = _without_impacts(base, how)
    of_impacts = _left_by_impacts(base, bare)
    now, last, fits, score_tests = known, known.fit, one_by_one(known, workspace.unlimited), [how.alone]
    scored = None if now.findings else how.alone
    while True:
        part = how.part(len(now.findings) / (most + 1.0), 1.0 / (most + 1.0))
        beside = f", with {now.names[-1]} in the model" if now.findings else ""
        part.progress(f"scoring all effects{beside}", 0.0)
        what = "further effects" if now.findings else "the search for effects"
        if scored is None:
            scored = workspace.in_time(partial(look, now.fit, workspace), what)
            score_tests.append(scored or NOTHING_SCORED)
        if scored is None or len(now.findings) >= most:
            break
        one = replace(part, found=now.findings, of_impacts=of_impacts)
        further = workspace.in_time(partial(_one_more, now, scored, one), what)
        if further is not None and further.names == now.names:
            last = further.fit  # too little for a name, but known
            break
        if further is None and not now.findings and most > 1:
            further = workspace.in_time(partial(add_two, now, scored, part), "two effects at once")
        if further is None:
            break
        now, scored = revised(further, part), None
        last = now.fit
        grown = now.names == further.names and len(now.names) == len(fits) + 1
        each = None if grown else tried(partial(one_by_one, now, workspace.unlimited))
        fits = [*fits, now.fit] if each is None else each
    if now.findings:
        exact = exactly(now.fit, workspace)
        last, now, fits = exact if last is now.fit else last, replace(now, fit=exact), [*fits[:-1], exact]
    findings = [replace(each, made_of=_made_of(each, now, workspace)) for each in now.findings]
    findings = [tried(partial(with_estimates, each, now.fit)) or each for each in findings]
    return Found(base, bare, tuple(findings), tuple(fits), tuple(score_tests), last)


def _one_more(now: Explanation, scored: ScoreTest, how: Search) -> Explanation | None:
    """`now` with the effect that explains most of its lack of fit; if formulas may leave as much, with the fit of that
    effect, but without its name; None if none passes."""
    workspace, seen = how.workspace, may_be_significant(scored)
    # In a fit of the model alone the disturbance may have grown to imitate what is missing, so that nothing shows.
    if not seen and (now.findings or not (how.confounded or undisturbed_fit(now.fit, workspace) is not None)):
        return None
    # With an effect in the model that does not quite fit, a lag distorts what is left: there the score test must see
    # it.
    more = flat_at_zero(workspace) if seen and not now.findings else []
    found = find(now.fit, scored, replace(how, confounded={*how.confounded, *more}))
    if found is None:
        return None
    return Explanation((*now.findings, found.finding) if isinstance(found, Named) else now.findings, found.fit)


def _held(base: FullFit, before: Explanation, how: Search) -> tuple[FullFit, Explanation]:
    """The fit of `base` with the random parts that its samples require beside the effects of `before`, and the
    explanation of these samples: all of `before`, or nothing if one of its effects is not significant here."""
    workspace = how.workspace
    if not before.findings:
        base = absorbed(base, base, workspace) or base
        return base, Explanation((), base)
    effects = before.fit.fitted.effects
    while True:
        whole = full(replace(base.model, effects=effects), workspace, longer=FURTHER_FITS)
        wider = absorbed(base, whole, workspace)
        if wider is None:
            break
        base = wider
    for each in before.findings:
        without = full(whole.model.remove(each.effect), workspace, longer=FURTHER_FITS)
        if not beyond_chance(*log_ratio(whole, without), len(workspace.candidates)):
            return base, Explanation((), base)
    return base, Explanation(before.findings, whole)


def _kept(found: Found, wider: FullFit, workspace: Workspace) -> Explanation:
    """The findings in the model of `wider`, which has a random part more than `found`; none if the random part explains
    so much that another effect may be more likely with it.

    Without the effects, it explains all that they leave, and some of what they explain. If that is less than their lead
    over the next effect and over none, they remain what is named.
    """
    random = wider.log_likelihood - found.base.log_likelihood
    if not found.findings or not all(likelier(each.lead - random) for each in found.findings):
        return Explanation((), wider)
    return Explanation(found.findings, _with_random_part(found.fits[-1], wider, workspace))


def _with_random_part(named: FullFit, wider: FullFit, workspace: Workspace) -> FullFit:
    """The fit of the model of `wider` with the effects of `named`."""
    model = replace(wider.model, effects=named.model.effects)
    begin = replace(wider.fit.end, values=named.fit.end.values)
    return remembered(model, workspace, begin=begin)


def _alone(base: FullFit, workspace: Workspace) -> ScoreTest:
    """The score test of the model alone, however long it takes."""
    return tried(partial(look, base, workspace.unlimited)) or NOTHING_SCORED


def _outdone(base: FullFit, alone: ScoreTest) -> bool:
    """Whether a random part seems to explain more than any effect does, neither of them fitted."""
    return expected_log_ratio(base) > max((score.gain for score in alone.scores), default=0.0)


def _without_impacts(base: FullFit, how: Search) -> FullFit:
    """The fit of the model without its effects whose parts collide; `base` if it has none, or diverges without them.

    What these leave, with them in the model, is a share of what they explain.
    """
    model = base.model
    for each in base.model.effects:
        if each.effect.impacts:
            model = model.remove(each.name)
    try:
        return base if model is base.model else settled(model, how.workspace.unlimited)
    except FAILURES:
        return base


def _left_by_impacts(base: FullFit, bare: FullFit) -> float:
    """Log-likelihood that the effects of `base` whose parts collide may leave; `bare` is without these."""
    errors = [each.effect.formula_error for each in base.model.effects if each.effect.impacts]
    return max(errors, default=0.0) * max(0.0, base.log_likelihood - bare.log_likelihood)


def _made_of(made: Finding, found: Explanation, workspace: Workspace) -> MadeOf | None:
    """`made`, one of the effects in `found`, expressed as the two that it combines; None if it combines none.

    Published friction of a bench is often given as the two.
    """
    parts = parts_of(made, found.findings, workspace)
    if not parts:
        return None
    model = found.fit.model.remove(made.effect)
    for each in parts:
        model = with_effect(model, each, each.variants[0])
    fit = partial(full, model, workspace, parts[-1])
    two = workspace.in_time(fit, f"{made.effect} as the two effects that it combines")
    if two is None or not two.fit.minimum.converged:
        return None
    parameters = {name: each for part in parts for name, each in sizes(part.name, two).items()}
    return MadeOf(parameters, two.log_likelihood - found.fit.log_likelihood)
