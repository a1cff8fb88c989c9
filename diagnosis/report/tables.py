"""The report's tables as rows of finished text: effects by probability, parameters, errors, detectable sizes."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from upright.diagnosis.diagnose import Diagnosis, Finding
from upright.diagnosis.prediction.compare import Comparison
from upright.diagnosis.prediction.relevance import percent
from upright.diagnosis.report.names import shown
from upright.diagnosis.report.sentences import two_digits
from upright.diagnosis.score.score_test import Score, ScoreTest
from upright.estimators.fit.random.disturbance import disturbances
from upright.estimators.methods.prediction_error import result
from upright.estimators.numbers import Scale, about, common, with_error
from upright.telemetry.recording import Recording

HARD_SPACE = "\N{NO-BREAK SPACE}"
UNKNOWN = "–"
NOTHING = "nothing"
"""Row among the effects for a model that lacks none of them."""
LEAST_SHOWN = 5e-4
"""Probability below which an effect is left out of a ranking, except for the first FEWEST."""
FEWEST = 4


@dataclass(frozen=True, slots=True)
class Ranked:
    """One effect in a ranking. `probability` 0 to 1; `group` is "tied" or empty; the rest is text."""

    name: str
    title: str
    probability: float
    group: str
    p_value: str
    size: str
    detectable: str

    @property
    def percent(self) -> str:
        percent = 100.0 * self.probability
        return f"{percent:.1f} %" if percent >= 0.1 or percent == 0.0 else "< 0.1 %"


@dataclass(frozen=True, slots=True)
class Ranking:
    """One step of the diagnosis: what was found, in words, and all candidates, the most likely first."""

    finding: Finding | None
    title: str
    rows: tuple[Ranked, ...]
    left_out: int

    @property
    def tied(self) -> int:
        """Rows in the bracket, which are the first ones."""
        return sum(row.group == "tied" for row in self.rows)


@dataclass(frozen=True, slots=True)
class ParameterRow:
    """A parameter as it was known (CAD), as fitted by the model alone, and with the effects; text."""

    name: str
    unit: str
    cad: str
    before: str
    after: str
    moved: str


@dataclass(frozen=True, slots=True)
class Relevant:
    """The share of the errors that a finding accounts for, as text, and whether that is negligible."""

    name: str
    title: str
    ahead: str
    closed_loop: str
    negligible: bool


def relevances(diagnosis: Diagnosis) -> list[Relevant]:
    """One for each finding, in order: those that are negligible last. Empty if no share is known."""
    if all(each.relevance is None for each in diagnosis.findings):
        return []
    return [
        Relevant(
            each.effect,
            each.definition.title,
            percent(each.relevance.ahead) if each.relevance else UNKNOWN,
            percent(each.relevance.closed_loop)
            if each.relevance and each.relevance.closed_loop is not None
            else UNKNOWN,
            each.negligible,
        )
        for each in diagnosis.findings
    ]


def horizon(diagnosis: Diagnosis) -> str:
    """The horizon of the relevances, with its unit."""
    known = next((each.relevance for each in diagnosis.findings if each.relevance), None)
    return f"{known.horizon:.3g}{HARD_SPACE}s" if known else ""


def shaken(diagnosis: Diagnosis) -> list[tuple[str, str, str]]:
    """Joint, the disturbance that the model alone leaves there, and the disturbance that is left with all findings."""
    if not diagnosis.disturbance:
        return []
    before = {each.joint: str(each) for each in disturbances(diagnosis.steps[0].fit)}
    return [(each.joint, before.get(each.joint, UNKNOWN), str(each)) for each in diagnosis.disturbance]


def limits(diagnosis: Diagnosis) -> list[tuple[str, str, str]]:
    """By channel, the RMS error of the best possible prediction: with the disturbance, and from the sensors alone."""
    limit = diagnosis.prediction_limit
    if limit is None or not diagnosis.steps:
        return []
    rows = []
    for output in diagnosis.steps[-1].model.outputs:
        if output.name in limit.disturbed:
            factor, unit = shown(output.unit)
            error, without = (factor * each[output.name] for each in (limit.disturbed, limit.undisturbed))
            rows.append(
                (output.name, f"{two_digits(error)}{HARD_SPACE}{unit}", f"{two_digits(without)}{HARD_SPACE}{unit}")
            )
    return rows


def rankings(diagnosis: Diagnosis) -> list[Ranking]:
    """One for each finding; if there is none, the effects that came nearest in the score test."""
    if not diagnosis.findings:
        return [_nearest(diagnosis.score_tests[0])] if diagnosis.score_tests and diagnosis.score_tests[0].scores else []
    return [_ranking(finding, finding.score_test) for finding in diagnosis.findings if finding.score_test is not None]


def _ranking(finding: Finding, score_test: ScoreTest) -> Ranking:
    bracket = {finding.effect, *finding.tied_with} if finding.tied_with else set()
    rows = []
    for name, odds in finding.odds.items():
        score = score_test.score(name)
        size = _found(finding, score) if name == finding.effect else _by_score(score)
        rows.append(_row(score, finding.probability * odds, "tied" if name in bracket else "", size))
    rows.sort(key=lambda row: (row.group != "tied", row.name != finding.effect, -row.probability))
    kept = [row for place, row in enumerate(rows) if place < FEWEST or row.probability >= LEAST_SHOWN or row.group]
    nothing = max(0.0, 1.0 - finding.probability * sum(finding.odds.values()))
    # Rounding may leave a hundredth of LEAST_SHOWN of a difference.
    title = "a model that lacks none of these"
    kept.append(Ranked(NOTHING, title, nothing if nothing > 0.01 * LEAST_SHOWN else 0.0, "", "", "", ""))
    return Ranking(
        finding, score_test.score(finding.effect).candidate.effect.title, tuple(kept), len(rows) + 1 - len(kept)
    )


def _nearest(score_test: ScoreTest) -> Ranking:
    rows = [_row(score, 0.0, "", _by_score(score)) for score in score_test.scores[: 2 * FEWEST]]
    return Ranking(None, "", tuple(rows), len(score_test.scores) - len(rows))


def _row(score: Score, probability: float, group: str, size: str) -> Ranked:
    candidate = score.candidate
    return Ranked(
        candidate.name, candidate.effect.title, probability, group, p_text(score.p_value), size, detectable(score)
    )


def _found(finding: Finding, score: Score) -> str:
    """All its parameters, from the fit."""
    found = [
        f"{_own(name)} ={HARD_SPACE}{_quantity(each.value, each.std, each.unit)}"
        for name, each in finding.parameters.items()
        if each.value is not None
    ]
    return "; ".join(found) if found else _by_score(score)


def _by_score(score: Score) -> str:
    """Its first amplitude, from the linearised model."""
    first = score.candidate.amplitudes[0]
    size, error = score.sizes[first], score.standard_errors[first]
    text = _quantity(size, error, _amplitude_unit(score)) if np.isfinite(error) else _roughly(size, score)
    return f"{_own(first)} ≈{HARD_SPACE}{text}"


def detectable(score: Score) -> str:
    """The smallest detectable size of its first amplitude."""
    if not np.isfinite(score.detectable):
        return "not detectable in this record"
    first = _own(score.candidate.amplitudes[0])
    return f"{first} ={HARD_SPACE}{_roughly(score.detectable, score)}"


def detectables(diagnosis: Diagnosis) -> list[tuple[str, str, str]]:
    """Effect, its title, the smallest size detectable in the recordings; by name."""
    scores = diagnosis.score_tests[0].scores if diagnosis.score_tests else ()
    return sorted((score.candidate.name, score.candidate.effect.title, detectable(score)) for score in scores)


def parameters(diagnosis: Diagnosis) -> list[ParameterRow]:
    """The estimated parameters, with their prior values."""
    if not diagnosis.steps:
        return []
    fitted = [result(step.fit, 0.0).parameters for step in (diagnosis.steps[0], diagnosis.steps[-1])]
    before, after = fitted
    # The start values: the model of a step still has them.
    known = {p.name: p for p in diagnosis.steps[0].model.parameters}
    rows = []
    for name, each in after.items():
        cad, first = known.get(name), before.get(name)
        moved = ""
        shown = {
            "cad": (None, None) if cad is None else (cad.value, cad.std),
            "before": (None, None) if first is None else (first.value, first.std),
            "after": (each.value, each.std),
        }
        scale = common(shown.values(), each.unit)
        if cad is not None and cad.std > 0.0:
            values = [one.value for one in ((first, each) if len(diagnosis.steps) > 1 else (each,)) if one is not None]
            moved = " → ".join("?" if value is None else f"{(value - cad.value) / cad.std:+.1f}" for value in values)
        rows.append(
            ParameterRow(
                name=name,
                unit=scale.unit,
                cad="" if cad is None else _hard(scale.text(*shown["cad"])),
                before="" if first is None else _determined(scale, *shown["before"]),
                after=_determined(scale, *shown["after"]),
                moved=moved,
            )
        )
    return rows


def remarks(diagnosis: Diagnosis) -> list[str]:
    """Why a value is not stated; parameters with the same reason together."""
    because: dict[str, list[str]] = {}
    if diagnosis.steps:
        for name, each in result(diagnosis.steps[-1].fit, 0.0).parameters.items():
            if each.reason:
                because.setdefault(each.reason, []).append(name)
    return [f"{', '.join(names)}: {reason}" for reason, names in because.items()]


def _determined(scale: Scale, value: float | None, std: float | None) -> str:
    return "not determined" if value is None or std is None else _hard(scale.text(value, std))


def _quantity(value: float | None, std: float | None, unit: str) -> str:
    return "not determined" if value is None or std is None else _hard(with_error(value, std, unit))


def _roughly(size: float, score: Score) -> str:
    """An amplitude of `score` with two digits."""
    return _hard(about(size, _amplitude_unit(score)))


def _hard(text: str) -> str:
    """`text` without places at which a line may break."""
    return text.replace(" ", HARD_SPACE)


def errors(comparisons: Sequence[Comparison]) -> Iterator[tuple[str, list[tuple[str, str, str]]]]:
    """By channel, for each model: fit in percent, RMS error with its unit, RMS error over that of noise."""
    outputs = {output.name: output for output in comparisons[0].innovations.problem.model.outputs}
    for channel in comparisons[0].fit_percent:
        factor, unit = shown(outputs[channel].unit)
        cells = [
            (
                f"{each.fit_percent[channel]:.2f} %",
                f"{factor * each.rmse[channel]:.3g} {unit}",
                f"{each.rmse[channel] / each.noise_floor[channel]:.3g}",
            )
            for each in comparisons
            if channel in each.fit_percent
        ]
        yield channel, cells


def p_text(value: float) -> str:
    """A p-value as people write it."""
    return "< 1e-6" if value < 1e-6 else f"{value:.2g}"


def left_out(diagnosis: Diagnosis) -> list[tuple[str, str]]:
    """Effects that were not tested, those with the same reason together, and the reason."""
    because: dict[str, list[str]] = {}
    for name, reason in sorted((diagnosis.left_out or {}).items()):
        because.setdefault(reason.removeprefix(f"effect {name}: "), []).append(name)
    return [(", ".join(names), reason) for reason, names in because.items()]


def used(diagnosis: Diagnosis, recordings: Sequence[Recording]) -> str:
    """How much of the recordings the diagnosis is based on."""
    if not diagnosis.steps:
        return ""
    whole = sum(recording.duration for recording in recordings)
    return f"{diagnosis.steps[0].fit.problem.span:.1f} of {whole:.1f} s"


def held(diagnosis: Diagnosis) -> Mapping[str, str]:
    """Values that were not estimated, by name: all others are based on them."""
    if not diagnosis.steps:
        return {}
    last = diagnosis.steps[-1]
    free = {p.name for p in last.fit.problem.parameters}
    return {p.name: _hard(with_error(p.value, p.std, p.unit)) for p in last.model.parameters if p.name not in free}


def _own(name: str) -> str:
    return name.rsplit(".", 1)[-1]


def _amplitude_unit(score: Score) -> str:
    first = score.candidate.amplitudes[0]
    return next(p.unit for p in score.candidate.attached.parameters if p.name == first)
