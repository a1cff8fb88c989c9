"""A diagnosis as a page of text."""

from __future__ import annotations

from collections.abc import Mapping

from rich.markup import escape
from rich.padding import Padding
from rich.table import Table

from diagnosis.diagnose import Diagnosis, Finding, Verdict
from diagnosis.explain import explained_by_none
from diagnosis.report.sentences import (
    NOTHING_MATTERS,
    disturbance_sentences,
    mattering,
    negligible,
    to_within,
    untried_sentence,
)
from service.output import page

HEADLINES = {
    Verdict.ADEQUATE: ("green", "adequate", "The model explains the recordings {to_within}."),
    Verdict.MISSING_EFFECT: ("yellow", "missing effect", "The model lacks a physical effect that has a name."),
    Verdict.UNKNOWN: ("red", "unknown", "The model lacks something that {explained_by_none}."),
    Verdict.INSUFFICIENT_DATA: ("red", "insufficient data", "The recordings cannot tell."),
}
BAR = 20


def print_diagnosis(found: Diagnosis, seconds: float) -> None:
    """Verdict, findings, and the smallest effects that would have shown, of a diagnosis within so many `seconds`."""
    colour, verdict, meaning = HEADLINES[found.verdict]
    matter = mattering(found)
    meaning = meaning.format(to_within=to_within(found), explained_by_none=explained_by_none(found.untried))
    if found.verdict is Verdict.MISSING_EFFECT and not matter:
        colour, verdict, meaning = "green", "negligible effect", f"{NOTHING_MATTERS.capitalize()}."
    if found.verdict is Verdict.UNKNOWN and matter:
        meaning = "What has a name is not all that the model lacks."
    if found.verdict is Verdict.ADEQUATE and found.unexplained and found.unexplained.struck:
        meaning = "No known effect is missing; what is left may be when its blows come."
    page.print(f"[bold {colour}]{verdict}[/]: {meaning}")
    if not found.findings or found.verdict is Verdict.UNKNOWN:
        page.print(Padding(escape(found.reason), (0, 2)))
    if found.innovation_ratio_before is not None and found.innovation_ratio_after is not None:
        page.print(
            f"Innovation energy over that of the noise: {found.innovation_ratio_before:.4g} before, "
            f"{found.innovation_ratio_after:.4g} after"
        )
    if told := disturbance_sentences(found):
        page.print(escape(told))
    if told := untried_sentence(found, seconds):
        page.print(f"[yellow]{escape(told)}[/]")
    for number, finding in enumerate(matter, 1):
        _print_finding(number, finding)
    for number, finding in enumerate(negligible(found), len(matter) + 1):
        if number == len(matter) + 1:
            page.print("\n[bold]Negligible: what shows, and makes less than 1 % of the error[/]")
        _print_finding(number, finding)
    if found.suggested_experiment:
        page.print(f"\nNext: {escape(str(found.suggested_experiment['text']))}")
    if found.minimum_detectable and found.repaired is not None:
        page.print()
        page.print(_detectable(found))
    for why, names in _reasons(found.left_out or {}).items():
        page.print(f"[dim]Not looked for: {', '.join(names)}: {escape(why)}[/]")


def _print_finding(number: int, finding: Finding) -> None:
    page.print()
    page.print(f"[bold]{number}. {finding.effect}[/] ({finding.family})")
    page.print(_ranking(finding))
    page.print(Padding(escape(finding.explanation), (0, 2)))


def _reasons(left_out: Mapping[str, str]) -> dict[str, list[str]]:
    """Reason to the effects that it holds for."""
    found: dict[str, list[str]] = {}
    for name, why in left_out.items():
        found.setdefault(why.removeprefix(f"effect {name}: "), []).append(name)
    return found


def _ranking(finding: Finding) -> Table:
    table = Table(box=None, show_header=False, padding=(0, 1))
    total = sum(finding.odds.values())
    for name, odds in sorted(finding.odds.items(), key=lambda each: -each[1])[:6]:
        share = odds / total
        mark = "tied" if name in finding.tied_with else ""
        table.add_row("", name, "█" * round(BAR * share) or "▏", f"{100.0 * share:.1f} %", mark)
    return table


def _detectable(found: Diagnosis) -> Table:
    table = Table(title="The smallest effects that would have shown", title_justify="left")
    table.add_column("effect")
    table.add_column("parameter")
    table.add_column("size", justify="right")
    sizes = found.minimum_detectable or {}
    score_tests = [part.score_tests[0] for part in found.parts or (found,) if part.score_tests]
    scores = {score.candidate.name: score for each in score_tests for score in each.scores}
    for _, score in sorted(scores.items()):
        if score.candidate.name not in sizes:
            continue
        first = score.candidate.amplitudes[0]
        unit = next(p.unit for p in score.candidate.attached.parameters if p.name == first)
        size = f"{sizes[score.candidate.name]:.3g}" + ("" if unit == "1" else f" {unit}")
        table.add_row(score.candidate.name, first.rsplit(".", 1)[-1], size)
    return table
