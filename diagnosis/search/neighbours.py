"""Sets of effects next to those that were found: another in place of one, two in place of one, one in place of two.

The first effect that was found had to explain all that is missing: quadratic drag and dry friction together look like
viscous friction, and with that in the model like Stribeck friction. With Stribeck friction in the model, though,
quadratic drag is missing, and with quadratic drag, plain dry friction. So each effect is removed in turn and searched
for as if it had not been found, until no name changes (`swap`): a floating search (Pudil, Novovicova, Kittler,
"Floating search methods in feature selection", 1994).

If effects are removed one at a time, an effect that has the parameters of two is never compared with these two:
friction that differs between the directions, with dry friction and a static torque. Nor is one that imitates two so
well that it leaves too little for a second name. So one is split in two (`split`), where it combines them or the scores
promise more of two, and two are merged (`merge`), for one cause is likelier than two: of M effects there are more pairs
than single ones, and each number of effects has the same prior probability (Chen, Chen, "Extended Bayesian information
criteria", 2008).

Nor does a search that begins with one effect find two that hide each other: they are searched for together (`add_two`).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from itertools import pairwise

from upright.diagnosis.evidence import LEVEL, beyond_chance, likelier
from upright.diagnosis.findings import Finding
from upright.diagnosis.fits.finer import is_finer
from upright.diagnosis.fits.refit import FullFit, full, log_ratio, remembered, with_effect
from upright.diagnosis.prepare.candidates import Candidate
from upright.diagnosis.prepare.workspace import Workspace
from upright.diagnosis.score.score_test import ScoreTest
from upright.diagnosis.search.contenders import flat_at_zero, look
from upright.diagnosis.search.explanation import Explanation, Search
from upright.diagnosis.search.further import left_by_formulas
from upright.diagnosis.search.one_more import Covered, Named, find, may_be_significant, named_alone
from upright.diagnosis.trial import tried
from upright.estimators.budget import OutOfTime
from upright.models.model import Model

PAIRS = 2
"""Pairs that are tried together, at most."""
TURNS = 2
"""How often each effect is searched for again, at most."""


def revised(now: Explanation, how: Search) -> Explanation:
    """`now` after each kind of neighbour was tried, as far as time allows."""
    for what, neighbour in NEIGHBOURS:
        try:
            now = tried(partial(neighbour, now, how)) or now
        except OutOfTime:
            how.workspace.leave(f"{what}, with {' and '.join(now.names)} in the model")
    return now


def swap(now: Explanation, how: Search) -> Explanation:
    """The effects of `now` as each is found with the others in the model.

    The last of them was found in that way already. An effect that is not missing with the others in the model is
    removed. The order stays if the names do; otherwise the effect that explains most comes first. The result is
    discarded if it explains less than `now`: without an effect a fit may end where none of the others helps.
    """
    workspace, found, whole = how.workspace, list(now.findings), now.fit
    settled, turns = 1, TURNS * len(found)
    for turn in range(turns):
        if settled >= len(found):
            break
        oldest = found.pop(0)
        how.progress(f"looking for {oldest.effect} again, with the others in the model", turn / turns)
        without = remembered(whole.model.remove(oldest.effect), workspace)
        beside = replace(how, found=tuple(found))
        new = _again(Named(oldest, replace(whole, candidate=_candidate(oldest.effect, workspace))), without, beside)
        if isinstance(new, Named):
            settled = settled + 1 if new.finding.effect == oldest.effect else 1
            found.append(new.finding)
            whole = new.fit
        elif new is None and beyond_chance(*log_ratio(whole, without), len(workspace.candidates)):
            settled += 1
            found.append(oldest)
        else:
            settled = 0
            whole = without
    if now.fit.log_likelihood - whole.log_likelihood > left_by_formulas(now.findings):
        return now
    place = {name: number for number, name in enumerate(now.names)}
    if {each.effect for each in found} == set(place):
        return Explanation(tuple(sorted(found, key=lambda each: place[each.effect])), whole)
    return Explanation(tuple(sorted(found, key=lambda each: -each.log_likelihood_gain)), whole)


def split(now: Explanation, how: Search) -> Explanation:
    """`now` with two effects in place of one that combines them, or that had to explain what two do, if the evidence
    for two is sufficient.

    Whatever the two are, each is searched for as in `swap`: with a static torque in the model, plain dry friction may
    not be missing.
    """
    workspace = how.workspace
    for made in now.findings if len(now.findings) < how.most else ():
        parts = parts_of(made, now.findings, workspace)
        if parts:
            start = with_effect(now.fit.model.remove(made.effect), parts[0], parts[0].variants[0])
            first = tried(partial(full, start, workspace, parts[0]))
        else:
            first = _promising(made, now, workspace)
        if first is None:
            continue
        how.progress(f"splitting {made.effect} in two", 0.97)
        others = tuple(each for each in now.findings if each is not made)
        two = _two(first, how, but=made.effect)
        if two is not None and two_are_likelier(two.fit, now.fit, len(now.findings), workspace):
            return swap(replace(two, findings=(*others, *two.findings)), how)
    return now


def _promising(made: Finding, now: Explanation, workspace: Workspace) -> FullFit | None:
    """The fit, with one of those effects in place of `made` that were fitted beside it, to which the score of another
    effect promises more than `made` explains; None if there is none.

    Quadratic drag and dry friction together look like viscous friction; with that in the model too little of either is
    left for a name. With quadratic drag in place of it, dry friction is what is missing most.
    """
    found = next((each for each in reversed(workspace.rounds) if each.named == made.effect), None)
    without, best, most = now.fit.model.remove(made.effect), None, now.fit.log_likelihood
    for each in found.passed if found else ():
        if each.name == made.effect:
            continue
        candidate = _candidate(each.name, workspace)
        fit = remembered(with_effect(without, candidate, candidate.variants[0]), workspace, candidate)
        missing = max(look(fit, workspace).scores, key=lambda score: score.gain, default=None)
        if missing is None or missing.candidate.name == made.effect:
            continue
        if (promised := fit.log_likelihood + missing.gain) > most:
            best, most = fit, promised
    return best


def merge(now: Explanation, how: Search) -> Explanation:
    """`now` with one effect that combines two in place of these two, if the evidence for two is not sufficient.

    If it is sufficient, but by no more than formulas deviate from real friction, the combined effect is tied with that
    of the two of its own family: friction that differs between the directions keeps its mean at rest, where its formula
    has none.
    """
    workspace, whole = how.workspace, now.fit
    named = {name: each for each in now.findings for name in each.tied_with}
    named |= {each.effect: each for each in now.findings}
    for made in workspace.candidates:
        parts = [named[name] for name in made.effect.made_of if name in named]
        if len(parts) != 2 or parts[0] is parts[1] or made.name in now.names:
            continue
        how.progress(f"merging {parts[0].effect} and {parts[1].effect}", 0.98)
        base = remembered(whole.model.remove(parts[0].effect).remove(parts[1].effect), workspace)
        one = named_alone(base, look(base, workspace), made, parts, workspace, is_finer(whole.model, workspace))
        if one is None:
            continue
        if not two_are_likelier(whole, one.fit, len(now.findings) - 1, workspace):
            others = (each for each in now.findings if all(each is not part for part in parts))
            return Explanation((one.finding, *others), one.fit)
        gain, together = (fit.log_likelihood - base.log_likelihood for fit in (one.fit, whole))
        if gain >= (1.0 - made.effect.formula_error) * together:
            tied = (_tied(each, made) if any(each is part for part in parts) else each for each in now.findings)
            now = Explanation(tuple(tied), whole)
    return now


Neighbour = Callable[[Explanation, Search], Explanation]
NEIGHBOURS: tuple[tuple[str, Neighbour], ...] = (
    ("each effect again", swap),
    ("two in place of one", split),
    ("one in place of two", merge),
)
"""Tried in this order, each with its name in `untried` if no time is left for it."""


def add_two(now: Explanation, scored: ScoreTest, how: Search) -> Explanation | None:
    """`now`, which has no effect, with two of which neither shows alone; None if the evidence for two is never
    sufficient.

    Each hides the other: for example, friction removes the energy that is added by a torque of the actuators. So each
    is searched for with the other in the model, as in `swap`.
    """
    workspace, base = how.workspace, now.fit
    for pair in scored.pairs[:PAIRS]:
        if pair.p_value >= LEVEL:
            return None
        first, second = pair.candidates
        how.progress(f"looking for {first.name} and {second.name} at once", 0.9)
        start = with_effect(base.model, first, pair.starts[0])
        two = tried(partial(_both, start, first, how))
        if two is not None and two_are_likelier(two.fit, base, 0, workspace):
            return two
    return None


def _both(start: Model, first: Candidate, how: Search) -> Explanation | None:
    return _two(full(start, how.workspace, first), how)


def _two(with_first: FullFit, how: Search, but: str = "") -> Explanation | None:
    """The effect found beside the first one, whose fit is given, and the one found in place of the first with that one
    in the model; None if one of them is not found, or is the effect `but`."""
    first = with_first.candidate
    assert first is not None
    one = _beside(with_first, how)
    if one is None or one.finding.effect == but:
        return None
    other = _beside(remembered(one.fit.model.remove(first.name), how.workspace), how)
    if other is None or other.finding.effect == but:
        return None
    return Explanation((one.finding, other.finding), other.fit)


def parts_of(made: Finding, findings: Sequence[Finding], workspace: Workspace) -> list[Candidate]:
    """The two effects that `made` combines; empty if one of them was found beside it."""
    parts = [each for name in made.definition.made_of for each in workspace.candidates if each.name == name]
    return [] if len(parts) != 2 or {each.name for each in parts} & {each.effect for each in findings} else parts


def _tied(part: Finding, made: Candidate) -> Finding:
    """`part`, tied with the effect `made` of it and another, if the two are of one family."""
    if part.definition.family is not made.effect.family or made.name in part.tied_with:
        return part
    return replace(part, tied_with=(*part.tied_with, made.name))


def two_are_likelier(two: FullFit, one: FullFit, count: int, workspace: Workspace) -> bool:
    """Whether the fit `two` is likelier than the fit `one`, which has `count` effects, by the odds required for a
    name."""
    candidates = len(workspace.candidates)
    rarer = math.comb(candidates, max(count + 1, 2)) / math.comb(candidates, count)
    return likelier(two.evidence - one.evidence, max(1.0, rarer))


def one_by_one(found: Explanation, workspace: Workspace) -> list[FullFit]:
    """The fit with the first of its effects, with the first two, and so on to the one with all of them."""
    fits = [found.fit] if found.findings else []
    for last, dropped in reversed(list(pairwise(found.findings))):
        fits.insert(0, remembered(fits[0].model.remove(dropped.effect), workspace, _candidate(last.effect, workspace)))
    return fits


def _candidate(name: str, workspace: Workspace) -> Candidate:
    return next(each for each in workspace.candidates if each.name == name)


def _beside(base: FullFit, how: Search) -> Named | None:
    scored = look(base, how.workspace)
    found = find(base, scored, how.quiet) if may_be_significant(scored) else None
    return found if isinstance(found, Named) else None


def _again(oldest: Named, without: FullFit, how: Search) -> Named | Covered | None:
    scored = look(without, how.workspace)
    if not may_be_significant(scored):
        return None
    more = {oldest.finding.effect}.intersection(flat_at_zero(how.workspace))
    return find(without, scored, replace(how.quiet, confounded={*how.confounded, *more}), oldest)
