"""Which effects a record does not tell apart, so that they are named together."""

from __future__ import annotations

from collections.abc import Sequence

from scipy.stats import chi2

from diagnosis.evidence import LEVEL, likelier
from diagnosis.refit import FullFit, full
from diagnosis.trial import FAILURES
from diagnosis.workspace import Workspace
from models.effect import Effect, Family

SIMPLER = 0.95
"""Share of the best gain in log likelihood with which an effect of fewer parameters is named instead.

Real friction is no formula, and what a further parameter gains by bending a little towards it is no evidence for
another effect."""
NEIGHBOUR = 0.9
"""Share of the gain with which a simpler effect, easily confused with the one that is named, is tied with it.

Friction with bristles gains 7 % more by one formula than by its own: what is less does not tell neighbours apart."""
DOUBT = 0.05
"""p-value of the likelihood ratio below which an effect of more parameters is tied with a simpler one that is named."""
EXACT = (Family.BIAS, Family.SENSOR)
"""Families whose formulas are what they say: a constant is a constant. Between two of them the likelihood ratio decides
alone, at LEVEL."""


def tied(best: FullFit, fits: Sequence[FullFit], base: FullFit, workspace: Workspace) -> tuple[str, ...]:
    """Which of `fits` may as well be `best`: by the odds or, where they are easily confused with it, by the likelihood.

    The odds contain the price of parameters, which tells no neighbours apart. A simpler one is tied where it gains
    almost as much, one with more parameters where the record asks for them, or would not tell it in its usual shape.
    """
    assert best.candidate is not None
    likeliest = max(each.evidence for each in fits)
    found: list[FullFit] = []
    for each in sorted(fits, key=lambda each: each.cost):
        if each is best or each.candidate is None:
            continue
        gain, other = (fit.log_likelihood - base.log_likelihood for fit in (best, each))
        likely = not likelier(likeliest - each.evidence)
        if exact(best, each) and each.count < best.count:
            likely = needless(best, each) >= LEVEL
        elif alike(best.candidate.effect, each.candidate.effect):
            if each.cost < best.cost:
                likely = likely or other >= NEIGHBOUR * gain
            elif each.cost > best.cost:
                # One that can be like the one that is named is an alternative only in what it does otherwise.
                asked = float(chi2.sf(2.0 * (other - gain), each.count - best.count)) < DOUBT
                likely = asked and (likely or gain < SIMPLER * other)
                near = not likelier(gain - other)
                likely = likely or (near and _as_likely_as_usual(best, each, base, workspace))
            # Of one that contains a tied one only what it gains beyond that would count.
            likely = likely and not any(
                other.cost < each.cost
                and other.log_likelihood - base.log_likelihood > SIMPLER * (each.log_likelihood - base.log_likelihood)
                for other in found
            )
        if likely:
            found.append(each)
    return tuple(each.name for each in fits if each in found)


def exact(one: FullFit, other: FullFit) -> bool:
    """Whether the two are easily confused, and neither is a formula for something that follows none."""
    assert one.candidate is not None
    assert other.candidate is not None
    effects = one.candidate.effect, other.candidate.effect
    return alike(*effects) and all(effect.family in EXACT for effect in effects)


def needless(more: FullFit, less: FullFit) -> float:
    """p-value of the likelihood ratio of `more`, which has more parameters: how well chance alone explains its gain.

    An instant that was picked among many has the price of these.
    """
    assert more.candidate is not None
    ratio = 2.0 * (more.log_likelihood - less.log_likelihood)
    tries = more.candidate.among if more.candidate.picked else 1
    return min(1.0, tries * float(chi2.sf(ratio, more.count - less.count)))


def _as_likely_as_usual(best: FullFit, other: FullFit, base: FullFit, workspace: Workspace) -> bool:
    """Whether `other`, held in its usual shape, explains the record as well as `best`: then this record tells nothing
    of its shape."""
    candidate = other.candidate
    assert candidate is not None
    if not candidate.shapes:
        return False
    own = {name: value for name, value in other.fitted.values.items() if name in candidate.amplitudes}
    try:
        held = full(
            base.model.add(candidate.effect, candidate.attached.at).change({**own, **candidate.variants[0]}),
            workspace,
            candidate,
        )
    except FAILURES:
        return False
    return not likelier(best.log_likelihood - held.log_likelihood)


def alike(one: Effect, other: Effect) -> bool:
    """Whether the two are easily confused, by the catalogue's own word."""
    return one.family is other.family or other.name in one.confused_with or one.name in other.confused_with
