"""Effects that were found one after the other, each looked for again beside the others.

The first one had to stand for all that is missing: quadratic drag and dry friction together look like viscous friction,
and beside that like Stribeck friction. Beside Stribeck friction, though, quadratic drag is what is missing, and beside
quadratic drag plain dry friction. So each effect is taken out in turn and looked for as if it had not been found, until
no name changes: a floating search (Pudil, Novovicova, Kittler, "Floating search methods in feature selection", 1994).

Taken out one at a time, an effect that has the parameters of two is never compared with these two: friction that
differs between the directions, with dry friction and a static torque. What is made of two is taken apart, and two are
put together, for one cause is likelier than two: of M effects there are more pairs than single ones, and each number of
effects is as likely before (Chen, Chen, "Extended Bayesian information criteria", 2008).

Nor does a search that begins with one find two of which each hides the other: they are looked for at once.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import replace
from itertools import pairwise

from diagnosis.contenders import Tell, look
from diagnosis.evidence import LEVEL, beyond_chance, likelier
from diagnosis.findings import Finding, MadeOf
from diagnosis.fits.finer import is_finer
from diagnosis.fits.refit import FullFit, full, gained, with_effect
from diagnosis.gates import NEIGHBOUR, alike
from diagnosis.prepare.candidates import Candidate
from diagnosis.prepare.workspace import Workspace
from diagnosis.score.score_test import Screen
from diagnosis.step import Named, find, named_alone, sizes, surprising, unseen_at_zero
from diagnosis.trial import FAILURES

FURTHER = 0.02
"""Share of what was gained so far that a further effect has to gain: no formula is exact, and a long record tells.

What play leaves looks like elasticity, which is a neighbour. With 0.05 friction or a torque beside it had no name."""
FURTHER_ALIKE = 0.1
"""The same for an effect that is easily confused with one that was found: it bends its formula."""
FURTHER_STRUCK = 0.2
"""The same beside one whose parts strike each other: fits of the same model end up to a tenth of what was gained apart,
as blows come a row early or late, and a torque that sets in somewhere moved 437 and 512 nats of 4,000."""
PAIRS = 2
"""Pairs that are looked for at once, at most."""
TURNS = 2
"""How often each effect is looked for again, at most."""


def exchange(
    findings: Sequence[Finding], whole: FullFit, workspace: Workspace, masked: Collection[str], tell: Tell
) -> tuple[list[Finding], FullFit]:
    """`findings` as each is found beside the others, and the fit with all of them; `whole` is that of the given ones.

    The last of `findings` was found beside the others. What is not missing beside the others is left out. The order
    stays where the names do; otherwise what explains most comes first. What it leads to is not taken where it explains
    less than what was there: without an effect a fit may end where none of the others helps.
    """
    found, given = list(findings), whole
    settled, turns = 1, TURNS * len(found)
    for turn in range(turns):
        if settled >= len(found):
            break
        oldest = found.pop(0)
        tell(f"looking for {oldest.effect} again, with the others in the model", turn / turns)
        without = full(whole.model.remove(oldest.effect), workspace)
        candidate = next(each for each in workspace.candidates if each.name == oldest.effect)
        new = _again(Named(oldest, replace(whole, candidate=candidate)), without, workspace, masked)
        if new is not None and new.finding.log_likelihood_gain >= asked(new.finding, found):
            settled = settled + 1 if new.finding.effect == oldest.effect else 1
            found.append(new.finding)
            whole = new.fit
        elif new is None and beyond_chance(*gained(whole, without), len(workspace.candidates)):
            settled += 1
            found.append(oldest)
        else:
            settled = 0
            whole = without
    if given.log_likelihood - whole.log_likelihood > _least(findings) * _gained(findings):
        return list(findings), given
    place = {each.effect: number for number, each in enumerate(findings)}
    if {each.effect for each in found} == set(place):
        return sorted(found, key=lambda each: place[each.effect]), whole
    return sorted(found, key=lambda each: -each.log_likelihood_gain), whole


def taken_apart(
    findings: Sequence[Finding], whole: FullFit, workspace: Workspace, masked: Collection[str], tell: Tell
) -> tuple[list[Finding], FullFit]:
    """`findings` with two in place of one that is made of two, where these are worth being two.

    What the two are called, each is looked for as in `exchange`: beside a static torque plain dry friction may be none.
    """
    for made in findings:
        parts = _parts(made, findings, workspace)
        if not parts:
            continue
        tell(f"taking {made.effect} apart", 0.97)
        others = [each for each in findings if each is not made]
        first = parts[0]
        start = with_effect(whole.model.remove(made.effect), first, first.variants[0])
        one = _beside(full(start, workspace, first), workspace, masked)
        if one is None or one.finding.effect == made.effect:
            continue
        other = _beside(full(one.fit.model.remove(first.name), workspace), workspace, masked)
        if other is None or other.finding.effect == made.effect:
            continue
        if not worth_two(other.fit, whole, len(findings), workspace):
            continue
        return exchange([*others, one.finding, other.finding], other.fit, workspace, masked, tell)
    return list(findings), whole


def made_of(made: Finding, findings: Sequence[Finding], whole: FullFit, workspace: Workspace) -> MadeOf | None:
    """`made`, one of `findings` that the fit `whole` has, told as the two that it is made of; None where it is of none.

    Those who publish a bench's friction often give the two.
    """
    parts = _parts(made, findings, workspace)
    if not parts:
        return None
    model = whole.model.remove(made.effect)
    for each in parts:
        model = with_effect(model, each, each.variants[0])
    try:
        two = full(model, workspace, parts[-1])
    except FAILURES:
        return None
    if not two.fit.minimum.converged:
        return None
    found = {name: each for part in parts for name, each in sizes(part.name, two).items()}
    return MadeOf(found, two.log_likelihood - whole.log_likelihood)


def _parts(made: Finding, findings: Sequence[Finding], workspace: Workspace) -> list[Candidate]:
    """The two that `made` is made of; none where one of them was found beside it."""
    parts = [each for name in made.definition.made_of for each in workspace.candidates if each.name == name]
    return [] if len(parts) != 2 or {each.name for each in parts} & {each.effect for each in findings} else parts


def put_together(
    findings: Sequence[Finding], whole: FullFit, workspace: Workspace, tell: Tell
) -> tuple[list[Finding], FullFit]:
    """`findings` with one that is made of two in place of these two, where they are not worth being two.

    Where they are, but by no more than formulas bend towards real friction, the one is tied with that of the two that
    is alike: friction that differs between the directions keeps its mean at rest, where its formula has none.
    """
    named = {name: each for each in findings for name in each.tied_with} | {each.effect: each for each in findings}
    for made in workspace.candidates:
        parts = [named[name] for name in made.effect.made_of if name in named]
        if len(parts) != 2 or parts[0] is parts[1] or made.name in {each.effect for each in findings}:
            continue
        tell(f"putting {parts[0].effect} and {parts[1].effect} together", 0.98)
        base = full(whole.model.remove(parts[0].effect).remove(parts[1].effect), workspace)
        one = named_alone(base, look(base, workspace), made, parts, workspace, is_finer(whole.model, workspace))
        if one is None:
            continue
        if worth_two(whole, one.fit, len(findings) - 1, workspace):
            gain, together = (fit.log_likelihood - base.log_likelihood for fit in (one.fit, whole))
            if gain >= NEIGHBOUR * together:
                findings = [_tied(each, made) if any(each is part for part in parts) else each for each in findings]
            continue
        return [one.finding, *(each for each in findings if all(each is not part for part in parts))], one.fit
    return list(findings), whole


def _tied(part: Finding, made: Candidate) -> Finding:
    """`part`, tied with what is `made` of it and another, where the two are of one family."""
    if part.definition.family is not made.effect.family or made.name in part.tied_with:
        return part
    return replace(part, tied_with=(*part.tied_with, made.name))


def two_at_once(
    base: FullFit, screened: Screen, workspace: Workspace, masked: Collection[str], tell: Tell
) -> tuple[list[Finding], FullFit] | None:
    """Two effects of which none shows alone, and the fit with them; None where no two are worth being two.

    Each takes away what shows of the other: friction the work that a torque does which the actuators bring along. So
    each is looked for beside the other, as in `exchange`.
    """
    for pair in screened.pairs[:PAIRS]:
        if pair.p_value >= LEVEL:
            return None
        first, second = pair.candidates
        tell(f"looking for {first.name} and {second.name} at once", 0.9)
        try:
            start = with_effect(base.model, first, pair.starts[0])
            one = _beside(full(start, workspace, first), workspace, masked)
            other = one and _beside(full(one.fit.model.remove(first.name), workspace), workspace, masked)
        except FAILURES:
            continue
        if one is not None and other is not None and worth_two(other.fit, base, 0, workspace):
            return exchange([one.finding, other.finding], other.fit, workspace, masked, tell)
    return None


def worth_two(two: FullFit, one: FullFit, count: int, workspace: Workspace) -> bool:
    """Whether the fit `two` is likelier by the odds of a name than the fit `one`, which has `count` effects."""
    candidates = len(workspace.candidates)
    rarer = math.comb(candidates, max(count + 1, 2)) / math.comb(candidates, count)
    return likelier(two.evidence - one.evidence, max(1.0, rarer))


def _beside(base: FullFit, workspace: Workspace, masked: Collection[str]) -> Named | None:
    screened = look(base, workspace)
    return find(base, screened, workspace, masked, lambda text, share: None) if surprising(screened) else None


def one_by_one(findings: Sequence[Finding], whole: FullFit, workspace: Workspace) -> list[FullFit]:
    """The fit with the first of `findings`, with the first two, and so on to `whole`, which has them all."""
    fits = [whole] if findings else []
    candidates = {each.name: each for each in workspace.candidates}
    for last, dropped in reversed(list(pairwise(findings))):
        model = fits[0].model.remove(dropped.effect)
        fits.insert(0, full(model, workspace, candidates[last.effect]))
    return fits


def _again(oldest: Named, without: FullFit, workspace: Workspace, masked: Collection[str]) -> Named | None:
    screened = look(without, workspace)
    if not surprising(screened):
        return None
    more = {oldest.finding.effect}.intersection(unseen_at_zero(workspace))
    return find(without, screened, workspace, {*masked, *more}, lambda text, share: None, oldest)


def asked(further: Finding, before: Sequence[Finding], of_blows: float = 0.0) -> float:
    """Gain in log likelihood that a further effect has to bring, beside those found before and beside the effects of
    the model as it was whose parts strike each other, which gain `of_blows`."""
    share = FURTHER_STRUCK if of_blows else _least(before)
    if any(alike(further.definition, each.definition) for each in before):
        share = max(share, FURTHER_ALIKE)
    return share * (of_blows + _gained(before))


def _least(findings: Sequence[Finding]) -> float:
    """Share of what `findings` gained that says something."""
    return FURTHER_STRUCK if any(each.definition.strikes for each in findings) else FURTHER


def _gained(findings: Sequence[Finding]) -> float:
    """Of log likelihood, by all of `findings`."""
    return sum(each.log_likelihood_gain for each in findings)
