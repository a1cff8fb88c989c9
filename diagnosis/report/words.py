"""The verdict in one line, all that matters in one sentence, and what to do next in another."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from upright.diagnosis.diagnose import Diagnosis, Finding, Verdict
from upright.diagnosis.explain import explained_by_none
from upright.diagnosis.prediction.relevance import percent
from upright.diagnosis.report.sentences import NOTHING_MATTERS, mattering, to_within
from upright.estimators.numbers import with_error
from upright.models.effect import Effect
from upright.telemetry.options import option


@dataclass(frozen=True, slots=True)
class Headline:
    """`kind` is the verdict as a word, which also names its colour and icon; `text` the line; `next_step` the
    advice."""

    kind: str
    word: str
    text: str
    next_step: str


def headline(diagnosis: Diagnosis) -> Headline:
    """The line that a person reads first."""
    if diagnosis.verdict is Verdict.MISSING_EFFECT and not mattering(diagnosis):
        return Headline(Verdict.ADEQUATE.value, "Negligible effect", NOTHING_MATTERS, next_step(diagnosis))
    return Headline(
        diagnosis.verdict.value,
        diagnosis.verdict.value.replace("_", " ").capitalize(),
        _line(diagnosis),
        next_step(diagnosis),
    )


def gist(diagnosis: Diagnosis) -> str:
    """The one sentence that matters: which effects the model lacks, their sizes, and how its error falls with them."""
    matter = mattering(diagnosis)
    if not matter:
        text = headline(diagnosis).text
        return f"{text[:1].upper()}{text[1:]}."
    fall = list(_falls(diagnosis, matter))
    those = "it" if len(matter) == 1 else "them"
    sentence = f"The model lacks {_listed([_sized(finding) for finding in matter])}"
    return f"{sentence}: with {those}, {' and '.join(fall)}." if fall else f"{sentence}."


def _sized(finding: Finding) -> str:
    """`viscous_friction (coefficient = 399 ± 13 N m s/rad)`, without a size that the recordings do not determine."""
    assert finding.score_test is not None
    candidate = finding.score_test.score(finding.effect).candidate
    known = [finding.parameters[name] for name in candidate.amplitudes[:1] if name in finding.parameters]
    sizes = [
        f" ({candidate.amplitudes[0].rsplit('.', 1)[-1]} = {with_error(each.value, each.std, each.unit)})"
        for each in known
        if each.value is not None
    ]
    return f"{_named(finding)}{''.join(sizes)}"


def _falls(diagnosis: Diagnosis, matter: Sequence[Finding]) -> Iterator[str]:
    before, after = diagnosis.innovation_ratio_before, diagnosis.innovation_ratio_after
    known = matter[0].relevance
    if before is not None and after is not None and after < before:
        yield f"the normalised innovation squared falls from {before:#.3g} to {after:#.3g} (1 for a right model)"
    if len(matter) == 1 and known is not None:
        yield f"the error energy {known.horizon:g} s ahead by {percent(known.ahead)}"


def _line(diagnosis: Diagnosis) -> str:
    matter = mattering(diagnosis)
    names = _listed([_named(finding) for finding in matter])
    match diagnosis.verdict:
        case Verdict.ADEQUATE:
            if diagnosis.unexplained is not None and diagnosis.unexplained.impacts:
                return "no known effect is missing; what is left may be due to the timing of the impacts"
            return f"the model explains these recordings {to_within(diagnosis)}"
        case Verdict.MISSING_EFFECT:
            alone = matter[0] if len(matter) == 1 else None
            if alone is not None and not alone.tied_with:
                names = f"{names}: {effect_of(diagnosis, 0, names).title}"
            return f"the model lacks {names}"
        case Verdict.UNKNOWN:
            found = f"{names} would explain a part; " if names else ""
            return f"{found}the model lacks something that {explained_by_none(diagnosis.untried)}"
        case Verdict.INSUFFICIENT_DATA:
            return "these recordings cannot show what the model lacks"


def _listed(names: Sequence[str]) -> str:
    *first, last = names or [""]
    return f"{', '.join(first)} and {last}" if first else last


def _named(finding: Finding) -> str:
    """With the effects that are indistinguishable from it."""
    return " or ".join((finding.effect, *finding.tied_with))


def next_step(diagnosis: Diagnosis) -> str:
    """One sentence."""
    if diagnosis.suggested_experiment:
        return _experiment(diagnosis.suggested_experiment)
    contradicted = diagnosis.contradicted
    if contradicted and (diagnosis.adequate or any(each.instead_of for each in contradicted)):
        return "Correct the stated values that the recordings contradict, or widen their ±, and diagnose again."
    match diagnosis.verdict:
        case Verdict.ADEQUATE:
            return "Use the model with the fitted values; there is nothing to add."
        case Verdict.INSUFFICIENT_DATA:
            return "Correct what the reason below names, record again, and diagnose again."
        case Verdict.UNKNOWN:
            return (
                "See below where the model still fails, describe the effect that you suspect in a file, and diagnose"
                f" again with {option('--also FILE.toml', 'also=')}."
            )
        case Verdict.MISSING_EFFECT:
            return _add_or_distinguish(diagnosis)


def _add_or_distinguish(diagnosis: Diagnosis) -> str:
    matter = mattering(diagnosis)
    if not matter:
        return "Use the model with the fitted values; the negligible effects may be left out."
    for place, finding in enumerate(matter):
        if finding.tied_with:
            how = effect_of(diagnosis, place, finding.effect).separated_by.rstrip(".")
            others = _listed(finding.tied_with)
            return f"Distinguish {finding.effect} from {others} before you rely on it: {how[:1].lower()}{how[1:]}."
    names = _listed([finding.effect for finding in matter])
    return f"Add {names} to the model (upright model add), and check it on a recording that it was not fitted to."


def effect_of(diagnosis: Diagnosis, step: int, name: str) -> Effect:
    """The effect called `name` that was among the candidates when finding number `step` was found."""
    scored = diagnosis.findings[step].score_test
    assert scored is not None
    return scored.score(name).candidate.effect


def _experiment(suggested: Mapping[str, Any]) -> str:
    """In its own words, if it has some."""
    text = suggested.get("text") or f"record {suggested['experiment']}"
    return f"Record once more, then diagnose again: {text}."
