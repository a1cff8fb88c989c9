"""A finding in words: what it is, how large, why this effect and not its neighbours, and what would distinguish
them."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import TYPE_CHECKING

from upright.diagnosis.prepare.candidates import Candidate
from upright.diagnosis.score.score_test import Score
from upright.estimators.contract import ParameterEstimate
from upright.estimators.numbers import about, with_error
from upright.models.effect import Role

if TYPE_CHECKING:
    from upright.diagnosis.findings import Finding

MENTIONED = 0.2
"""Share of the finding's log-likelihood ratio above which that of its nearest neighbour is mentioned: a neighbour that
explains a part may be mistaken for the whole."""


def explain(finding: Finding, score: Score) -> str:
    """A paragraph of plain sentences."""
    candidate, effect = score.candidate, score.candidate.effect
    prefix = f"{candidate.name}."
    sizes = _sizes(finding.parameters, prefix)
    formula = effect.with_parameters(name.removeprefix(prefix) for name in finding.parameters)
    sentences = [f"{effect.name}: {effect.title} ({formula.equation})" + (f"; {sizes}" if sizes else "") + "."]
    sentences.append(effect.signature)
    for name in candidate.attached.of_role(Role.INSTANT):
        instant = finding.parameters.get(name)
        if instant is not None and instant.value is not None:
            sentences.append(f"It sets in at {instant.value:.1f} s: an event, not a property of the vehicle.")
    if all(finding.parameters[name].value is None for name in candidate.amplitudes if name in finding.parameters):
        sentences.append("These data do not determine its amplitude.")
    first = candidate.amplitudes[0]
    chance = f"chance explains the finding with a probability of {_probability(finding.p_value)}."
    # The detectable amplitude follows from the derivative at amplitude zero, which says nothing of impacts, and from
    # the innovations of the model without the effect, in which a large effect is noise that hides a smaller one.
    found = finding.parameters[first].value if first in finding.parameters else None
    least = about(score.detectable, _unit(candidate, first))
    shown = f"This record would have shown {least} of {first.split('.')[-1]}; "
    says_nothing = effect.impacts or (found is not None and abs(found) < score.detectable)
    sentences.append(chance.capitalize() if says_nothing else shown + chance)
    others = [name for name in finding.odds if name != finding.effect]
    if finding.tied_with:
        tied = ", ".join(finding.tied_with)
        sentences.append(f"Tied with {tied}: this excitation hardly distinguishes them. {effect.separated_by}")
    if others:
        nearest = max(others, key=lambda name: (finding.odds[name], finding.gains[name]))
        if nearest not in finding.tied_with:
            sentences.append(f"Its nearest neighbour, {nearest}, is {_odds(finding.odds[nearest])} times less likely.")
        share = finding.gains[nearest]
        if share > MENTIONED:
            sentences.append(
                f"With {nearest} instead, the log-likelihood rises by {100.0 * share:.0f} % as much: a smaller error "
                "alone proves little."
            )
    if finding.made_of is not None:
        two, gain = finding.made_of, finding.made_of.log_likelihood_gain
        sentences.append(
            f"Expressed as the two effects that it combines, {_sizes(two.parameters)}; "
            f"the log-likelihood is {abs(gain):.3g} "
            f"{'higher' if gain > 0.0 else 'lower'} with these."
        )
    if finding.relevance is not None:
        sentences.append(str(finding.relevance))
    if finding.held_out is not None:
        gain, std = finding.held_out.gain, finding.held_out.std
        sentences.append(f"On held-out data the log-likelihood rises by {with_error(gain, std)}.")
    else:
        sentences.append("No part of these data determines it well enough for a check on the rest: record once more.")
    return " ".join(sentences)


def together(findings: Sequence[Finding]) -> str:
    """Several findings as one reason: those that matter with their explanation, those that are negligible in one
    sentence each."""
    matter = [each.explanation for each in findings if not each.negligible] or ["nothing is missing that matters."]
    return "; ".join(matter) + "".join(
        f" {each.effect} is detectable but negligible: {str(each.relevance).removesuffix(': negligible.').lower()}."
        for each in findings
        if each.negligible
    )


def _sizes(parameters: Mapping[str, ParameterEstimate], prefix: str = "") -> str:
    return ", ".join(
        f"{name.removeprefix(prefix)} = {with_error(each.value, each.std, each.unit)}"
        for name, each in parameters.items()
        if each.value is not None and each.std is not None
    )


def _unit(candidate: Candidate, name: str) -> str:
    return next(p.unit for p in candidate.attached.parameters if p.name == name)


def _probability(value: float) -> str:
    return f"less than {1e-6:g}" if value < 1e-6 else f"{value:.2g}"


def _odds(value: float) -> str:
    ratio = 1.0 / max(value, 1e-9)
    return "a million" if ratio > 1e6 else f"{ratio:.2g}" if ratio < 1000.0 else f"{ratio:.0f}"


def explained_by_none(untried: Collection[str]) -> str:
    """The words after "something that": they do not refer to the whole catalogue while some of it is `untried`."""
    return "no effect tried so far explains" if untried else "no known effect explains"
