"""The output of `upright model add` as text: errors and parameters before and after, error budget, sentences."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from rich.table import Table
from rich.text import Text

from upright.diagnosis.report.revision_words import in_words, odds_text, readable
from upright.diagnosis.report.sentences import disturbance_text
from upright.diagnosis.revise.drop_tests import DropTest
from upright.diagnosis.revise.result import Budget, Revision
from upright.estimators.numbers import common
from upright.service.output import page

BAR = 60
"""Columns of the budget's bar."""
SHADES = (("sensors", "░"), ("effect", "█"), ("unexplained", "▒"))


def print_revision(revision: Revision) -> None:
    """Print the whole page."""
    page.print(f"Fitted: {', '.join(revision.recordings)}. Held out: {', '.join(revision.held_out)}.", markup=False)
    page.print()
    page.print(_errors(revision))
    page.print()
    page.print(_parameters(revision))
    for when, side in (("before", revision.before), ("after", revision.after)):
        if text := disturbance_text(side.disturbance):
            page.print(f"Disturbance {when}: {text}", markup=False)
    last = revision.horizons[-1]
    page.print(f"\nHeld-out error energy {last:g} s ahead, before {revision.effect} was added", style="bold")
    for line in budget_lines(revision.budget, revision.effect):
        page.print(line, markup=False)
    page.print()
    for sentence in in_words(revision):
        page.print(sentence, markup=False)


def budget_lines(budget: Budget, effect: str) -> list[str]:
    """The bar and its legend."""
    shares = (budget.sensors, budget.effect, budget.unexplained)
    edges = [round(BAR * sum(shares[:count])) for count in range(4)]
    bar = "".join(shade * (end - start) for (_, shade), start, end in zip(SHADES, edges[:-1], edges[1:], strict=True))
    names = ("sensors", effect, "unexplained")
    legend = (
        f"{shade} {name} {100.0 * share:.1f} %" for (_, shade), name, share in zip(SHADES, names, shares, strict=True)
    )
    return [bar, "   ".join(legend)]


def print_drop_tests(tests: Sequence[DropTest], file: str) -> None:
    """Print one row per effect, those that can be removed first."""
    if not tests:
        page.print(f"{file} has no effects.", markup=False)
        return
    rows = [
        (
            each.effect,
            f"{each.likelihood_ratio:.1f}",
            f"{each.degrees}",
            f"{each.bic_difference:+.1f}",
            odds_text(each.odds),
            each.verdict,
        )
        for each in tests
    ]
    page.print(_table(("effect", "likelihood\nratio", "parameters", "BIC\nwithout it", "odds for it", ""), rows))
    for each in tests:
        if not each.needed:
            page.print(f"`upright model remove {file} {each.effect}` removes it; then repeat the test.", markup=False)
            break


def _errors(revision: Revision) -> Table:
    rows = []
    kinds = (
        revision.before.training,
        revision.after.training,
        revision.before.held_out,
        revision.after.held_out,
        revision.floor_held_out,
    )
    for channel, unit in revision.units.items():
        shown, factor = readable(unit)
        name = f"{channel}, {shown}"
        for place, horizon in enumerate(revision.horizons):
            rows.append((name, f"{horizon:g} s", *(f"{factor * errors[channel][place]:.3g}" for errors in kinds)))
            name = ""
    headings = ("RMS error", "ahead", "fitted\nbefore", "\nafter", "held out\nbefore", "\nafter", "sensors\nalone")
    return _table(headings, rows)


def _parameters(revision: Revision) -> Table:
    rows = []
    for name, after in revision.after.parameters.items():
        before, moved = revision.before.parameters.get(name), revision.moved.get(name)
        given = None if moved is None else moved.cad
        known = [(each.value, each.std) for each in (before, after) if each is not None]
        scale = common([*known, (given, None)], after.unit)
        cad = ("", "") if moved is None else (scale.text(given), f"{moved.before:+.1f} → {moved.after:+.1f}")
        note = "" if after.status == "ok" else f"{after.status.replace('_', ' ')}"
        first = "" if before is None else scale.text(before.value, before.std)
        rows.append((name, first, scale.text(after.value, after.std), scale.unit, *cad, note))
    return _table(("parameter", "before", "after", "unit", "CAD", "std\nfrom CAD", ""), rows)


def _table(headings: Sequence[str], rows: Iterable[Sequence[str]]) -> Table:
    table = Table(box=None, pad_edge=False, header_style="bold")
    for place, heading in enumerate(headings):
        left = place == 0 or heading in ("", "unit")
        table.add_column(heading, justify="left" if left else "right", no_wrap=place == 0)
    for row in rows:
        table.add_row(*map(Text, row))
    return table
