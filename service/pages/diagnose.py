"""A diagnosis as text."""

from __future__ import annotations

from collections.abc import Mapping

from rich.console import Console
from rich.markup import escape
from rich.padding import Padding
from rich.table import Table

from upright.diagnosis.diagnose import Diagnosis, Finding, Verdict
from upright.diagnosis.report.sentences import (
    contradiction_sentences,
    disturbance_sentences,
    mattering,
    negligible,
    untried_sentence,
)
from upright.diagnosis.report.words import headline
from upright.estimators.numbers import about
from upright.service.output import page

COLOURS = {"adequate": "green", "missing_effect": "yellow", "unknown": "red", "insufficient_data": "red"}
"""Colour of a headline, by its kind."""
BAR = 20


def print_diagnosis(found: Diagnosis, seconds: float, to: Console = page) -> None:
    """Print verdict, findings and minimum detectable effects of a diagnosis that was limited to `seconds`."""
    head, matter = headline(found), mattering(found)
    to.print(f"[bold {COLOURS[head.kind]}]{head.word.lower()}[/]: {escape(head.text)}.")
    if not found.findings or found.verdict is Verdict.UNKNOWN:
        to.print(Padding(escape(found.reason), (0, 2)))
    if found.innovation_ratio_before is not None and found.innovation_ratio_after is not None:
        to.print(
            f"Normalised innovation squared (1 for a right model): {found.innovation_ratio_before:.4g} before, "
            f"{found.innovation_ratio_after:.4g} after"
        )
    if shaking := disturbance_sentences(found):
        to.print(escape(shaking))
    if contradicted := contradiction_sentences(found):
        to.print(f"[yellow]{escape(contradicted)}[/]")
    if left := untried_sentence(found, seconds):
        to.print(f"[yellow]{escape(left)}[/]")
    for number, finding in enumerate(matter, 1):
        _print_finding(number, finding, to)
    for number, finding in enumerate(negligible(found), len(matter) + 1):
        if number == len(matter) + 1:
            to.print("\n[bold]Negligible: significant, but less than 1 % of the error[/]")
        _print_finding(number, finding, to)
    to.print(f"\nNext: {escape(head.next_step)}")
    if found.minimum_detectable and found.revised is not None:
        to.print()
        to.print(_detectable(found))
    for why, names in _reasons(found.left_out or {}).items():
        to.print(f"[dim]Not tested: {', '.join(names)}: {escape(why)}[/]")


def _print_finding(number: int, finding: Finding, to: Console) -> None:
    to.print()
    to.print(f"[bold]{number}. {finding.effect}[/] ({finding.family})")
    to.print(_ranking(finding))
    to.print(Padding(escape(finding.explanation), (0, 2)))


def _reasons(left_out: Mapping[str, str]) -> dict[str, list[str]]:
    """The effects that were not tested, by reason."""
    found: dict[str, list[str]] = {}
    for name, why in left_out.items():
        found.setdefault(why.removeprefix(f"effect {name}: "), []).append(name)
    return found


def _ranking(finding: Finding) -> Table:
    table = Table(box=None, show_header=False, padding=(0, 1))
    total = sum(finding.odds.values())
    # The named effect is first, whatever the others' odds: it passed all checks.
    for name, odds in sorted(finding.odds.items(), key=lambda each: (each[0] != finding.effect, -each[1]))[:6]:
        share, named = odds / total, name == finding.effect
        mark = "named" if named else "tied" if name in finding.tied_with else ""
        bar = "█" * round(BAR * share) or "▏"
        table.add_row("", name, bar, f"{100.0 * share:.1f} %", mark, style="bold" if named else "")
    return table


def _detectable(found: Diagnosis) -> Table:
    table = Table(title="Minimum detectable effects", title_justify="left")
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
        table.add_row(score.candidate.name, first.rsplit(".", 1)[-1], about(sizes[score.candidate.name], unit))
    return table
