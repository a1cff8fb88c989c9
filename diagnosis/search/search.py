"""The search for what a model lacks: effect after effect, as each is beside the others, and beside random parts.

    score all effects that the model does not have
    -> one effect more (search.one_more), or two of which neither shows alone
    -> the neighbours of what is found by now (search.neighbours): another in place of each, two of one, one of two
    -> again, until nothing passes

Then random parts are looked for beside the effects, and the effects again beside each, as long as all of them together
gain evidence. A random part is no finding about the vehicle.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

from diagnosis.evidence import beyond_chance
from diagnosis.findings import Finding, MadeOf
from diagnosis.fits.random_parts import RANDOM, absorbed, expected_log_ratio
from diagnosis.fits.refit import FURTHER_FITS, FullFit, full, log_ratio, settled, with_effect
from diagnosis.prepare.workspace import Workspace
from diagnosis.score.score_test import ScoreTest
from diagnosis.search.contenders import flat_at_zero, look, still
from diagnosis.search.explanation import NOTHING_SCORED, Explanation, Search
from diagnosis.search.further import asked
from diagnosis.search.neighbours import add_two, one_by_one, parts_of, revised
from diagnosis.search.one_more import find, retold, sizes, surprising
from diagnosis.trial import FAILURES, tried

HALF = 0.5
"""Share of the time for each of two searches: without a random part that seems to explain most, and beside it."""
ONCE = 0.75
"""Share of the progress bar that is over when work is done that may have to be done again; for the bar alone."""


@dataclass(frozen=True, slots=True)
class Found:
    """What a search ends with.

    `base`: the fit of the model alone; `bare`: that without its effects whose parts strike each other; `fits` with the
    first of `findings`, with the first two, and so on; `score_tests` before each and after the last. `last`: the fit of
    all that was found, which may be one effect more than has a name: what explains too little for one, but no more is
    unknown than what that bends.
    """

    base: FullFit
    bare: FullFit
    findings: tuple[Finding, ...]
    fits: tuple[FullFit, ...]
    score_tests: tuple[ScoreTest, ...]
    last: FullFit


def search(base: FullFit, how: Search, before: Explanation | None = None) -> Found:
    """The effects that `base`, the fit of a model alone, lacks, beside the random parts that the record asks for.

    `before`: what explains these samples and others; the search goes on from it where it holds here.
    """
    workspace = how.workspace
    held = workspace.in_time(partial(_held, base, before, how), RANDOM) if before else None
    base, known = held or (base, Explanation((), base))
    # Where a random part explains more than any effect seems to, the search without it leaves it half of the time.
    hurried = not known.findings and _outdone(base, how)
    first = replace(how, workspace=workspace.within(HALF)) if hurried else how
    begun = ONCE
    found = _effects(base, known, first.part(0.0, begun))
    while True:
        wider = workspace.in_time(partial(absorbed, found.base, found.last, workspace), RANDOM)
        if wider is None:
            return found
        own = replace(how, workspace=replace(workspace, untried=[])).part(begun, ONCE * (1.0 - begun))
        again = _effects(wider, Explanation((), wider), own)
        begun += ONCE * (1.0 - begun)
        for each in own.workspace.untried:
            workspace.leave(each)
        cut_short = own.workspace.untried and not again.findings
        if (found.findings and cut_short) or again.last.evidence <= found.last.evidence:
            return found
        found = again


def _effects(base: FullFit, known: Explanation, how: Search) -> Found:
    """Effect after effect beside the `known` ones, at most as many as `how` says."""
    workspace, most = how.workspace, how.most
    bare = _without_impacts(base, how)
    of_impacts = _left_by_impacts(base, bare)
    now, last, fits, score_tests = known, known.fit, one_by_one(known, workspace.unlimited), list[ScoreTest]()
    if now.findings:
        score_tests.append(tried(partial(look, base, workspace.unlimited)) or NOTHING_SCORED)
    while True:
        part = replace(how, alone=score_tests[0] if score_tests else NOTHING_SCORED)
        part = part.part(len(now.findings) / (most + 1.0), 1.0 / (most + 1.0))
        beside = f", with {now.names[-1]} in the model" if now.findings else ""
        part.tell(f"scoring all effects{beside}", 0.0)
        what = "further effects" if now.findings else "the search for effects"
        scored = workspace.in_time(partial(look, now.fit, workspace if score_tests else workspace.unlimited), what)
        score_tests.append(scored or NOTHING_SCORED)
        if scored is None or len(now.findings) >= most:
            break
        further = workspace.in_time(partial(_one_more, now, scored, part), what)
        if further is not None:
            *before, new = further.findings
            if new.log_likelihood_gain < asked(new, before, score_tests[0], of_impacts):
                last = further.fit  # too little for a name, but known
                break
        if further is None and not now.findings and most > 1:
            further = workspace.in_time(partial(add_two, now, scored, part), "two effects at once")
        if further is None:
            break
        now = revised(further, part)
        last = now.fit
        grown = now.names == further.names and len(now.names) == len(fits) + 1
        alone = None if grown else tried(partial(one_by_one, now, workspace.unlimited))
        fits = [*fits, now.fit] if alone is None else alone
    findings = [replace(each, made_of=_made_of(each, now, workspace)) for each in now.findings]
    findings = [tried(partial(retold, each, now.fit)) or each for each in findings]
    return Found(base, bare, tuple(findings), tuple(fits), tuple(score_tests), last)


def _one_more(now: Explanation, scored: ScoreTest, how: Search) -> Explanation | None:
    """`now` with the effect that explains most of what it leaves; None where none stands."""
    workspace, seen = how.workspace, surprising(scored)
    # In a fit of the model alone a disturbance may have grown to what is missing, beside which nothing shows.
    if not seen and (now.findings or not (how.confounded or still(now.fit, workspace) is not None)):
        return None
    # Beside an effect that does not quite fit, a lag bends what is left: there the score test has to see it.
    more = flat_at_zero(workspace) if seen and not now.findings else []
    found = find(now.fit, scored, replace(how, confounded={*how.confounded, *more}))
    return None if found is None else Explanation((*now.findings, found.finding), found.fit)


def _held(base: FullFit, before: Explanation, how: Search) -> tuple[FullFit, Explanation]:
    """The fit of `base` with the random parts that its rows ask for beside the effects of `before`, and what explains
    these rows: all of `before`, or nothing where one of its effects is no more than chance here."""
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


def _outdone(base: FullFit, how: Search) -> bool:
    """Whether a random part seems to explain more than any effect does, neither of them fitted."""
    gain = expected_log_ratio(base)
    if not gain:
        return False
    scored = how.workspace.in_time(partial(look, base, how.workspace), "the search for effects")
    return scored is not None and gain > max((score.gain for score in scored.scores), default=0.0)


def _without_impacts(base: FullFit, how: Search) -> FullFit:
    """The fit of the model without those of its effects whose parts strike each other; `base` where it has none, or
    diverges without them.

    What is left of these, once they are in the model, is a share of what they explain.
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
    """Log likelihood that the effects of `base` whose parts strike each other may leave; `bare` is without these."""
    errors = [each.effect.formula_error for each in base.model.effects if each.effect.impacts]
    return max(errors, default=0.0) * max(0.0, base.log_likelihood - bare.log_likelihood)


def _made_of(made: Finding, found: Explanation, workspace: Workspace) -> MadeOf | None:
    """`made`, one of what was `found`, told as the two that it is made of; None where it is of none.

    Those who publish a bench's friction often give the two.
    """
    parts = parts_of(made, found.findings, workspace)
    if not parts:
        return None
    model = found.fit.model.remove(made.effect)
    for each in parts:
        model = with_effect(model, each, each.variants[0])
    fit = partial(full, model, workspace, parts[-1])
    two = workspace.in_time(fit, f"{made.effect} as the two that it is made of")
    if two is None or not two.fit.minimum.converged:
        return None
    told = {name: each for part in parts for name, each in sizes(part.name, two).items()}
    return MadeOf(told, two.log_likelihood - found.fit.log_likelihood)
