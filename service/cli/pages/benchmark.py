"""How the figures of the benchmark are shown to people: methods side by side, each figure with interval and cases."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING

from service.output import page

if TYPE_CHECKING:
    from service.hidden_effects.results.summary import Figure, Merit, Summary

Row = tuple[str, str, "Callable[[Merit], Figure | None]", bool]
"""Heading, what is wanted, the figure of a method, whether it is a share."""


def print_summary(summary: Summary) -> None:
    """All figures as a table, then the sizes that were asked and what could not be."""
    from rich.table import Table

    if not summary.methods:
        page.print("No case is done.")
    else:
        table = Table(box=None, pad_edge=False, padding=(0, 2, 0, 0), header_style="bold", title_justify="left")
        table.add_column("figure")
        table.add_column("wanted", justify="right")
        for name in summary.methods:
            table.add_column(name)
        for heading, wanted, figure, percent in _rows(summary):
            cells = [_cell(figure(merit), percent) for merit in summary.methods.values()]
            table.add_row(heading, wanted, *cells)
        page.print(table)
        page.print("Value (95 % interval) number of cases. Seen: at twice the detectable size and more.")
    for conditions, sizes in summary.detectable.items():
        told = ", ".join(f"{effect} {size:.3g}" for effect, size in sizes.items())
        page.print(f"Detectable with {conditions}: {told}")
    counts = ", ".join(f"{count} {status}" for status, count in summary.cases.items())
    page.print(f"Cases ({summary.conditions or 'none'}): {counts or 'none'}")


def _rows(summary: Summary) -> Iterator[Row]:
    merits = list(summary.methods.values())

    def keys(of: Callable[[Merit], object]) -> list[str]:
        return list(dict.fromkeys(key for merit in merits for key in of(merit)))  # type: ignore[attr-defined]

    yield "right first, or tied with one: seen", ">= 97 %", lambda merit: merit.right_seen, True
    for size in sorted(keys(lambda merit: merit.right), key=float):
        yield f"  at {size} detectable sizes", "", lambda merit, size=size: merit.right.get(size), True  # type: ignore[misc]
    for name in keys(lambda merit: merit.right_by_excitation):
        yield f"  with {name}", "", lambda merit, name=name: merit.right_by_excitation.get(name), True  # type: ignore[misc]
    for name in keys(lambda merit: merit.right_by_disturbance):
        yield f"  shaken by {name}", "", lambda merit, name=name: merit.right_by_disturbance.get(name), True  # type: ignore[misc]
    yield "  said to be unknown", "", lambda merit: merit.seen_unknown, True
    for name in keys(lambda merit: merit.seen_unknown_by_disturbance):
        yield f"    shaken by {name}", "", lambda merit, name=name: merit.seen_unknown_by_disturbance.get(name), True  # type: ignore[misc]
    yield "false alarms", "<= 1 %", lambda merit: merit.false_alarms_all, True
    for name in keys(lambda merit: merit.false_alarms):
        yield f"  with {name}", "", lambda merit, name=name: merit.false_alarms.get(name), True  # type: ignore[misc]
    for name in keys(lambda merit: merit.false_alarms_by_disturbance):
        yield f"  shaken by {name}", "", lambda merit, name=name: merit.false_alarms_by_disturbance.get(name), True  # type: ignore[misc]
    yield "a name of what is not there", "<= 1 %", lambda merit: merit.false_names, True
    yield "  that is not said to be negligible", "<= 1 %", lambda merit: merit.false_names_that_matter, True
    yield "not in the catalogue: called unknown", ">= 90 %", lambda merit: merit.unlisted_unknown, True
    yield "  given a name", "<= 5 %", lambda merit: merit.unlisted_misnamed, True
    yield "two effects: both found, seen", ">= 80 %", lambda merit: merit.both_seen, True
    for size in sorted(keys(lambda merit: merit.both), key=float):
        yield f"  at {size} detectable sizes", "", lambda merit, size=size: merit.both.get(size), True  # type: ignore[misc]
    for name in keys(lambda merit: merit.both_by_disturbance):
        yield f"  shaken by {name}", "", lambda merit, name=name: merit.both_by_disturbance.get(name), True  # type: ignore[misc]
    yield "held-out error closed, median", ">= 0.99", lambda merit: merit.held_out_closed, False
    yield "energy over floor after, median", "<= 1.01", lambda merit: merit.energy_over_floor, False
    yield "95 % intervals cover", "93 to 97 %", lambda merit: merit.covered, True
    for name in keys(lambda merit: merit.disturbance_covered):
        title = f"  of the disturbance's {name.replace('_', ' ')}"
        yield title, "93 to 97 %", lambda merit, name=name: merit.disturbance_covered.get(name), True  # type: ignore[misc]
        title = "    where all that is hidden is named"
        yield title, "93 to 97 %", lambda merit, name=name: merit.disturbance_covered_named.get(name), True  # type: ignore[misc]
    yield "seconds a diagnosis, median", "", lambda merit: merit.seconds, False


def _cell(figure: Figure | None, percent: bool) -> str:
    if figure is None or figure.value is None:
        return "-"
    if percent:
        assert figure.low is not None
        assert figure.high is not None
        return f"{100 * figure.value:.0f} % ({100 * figure.low:.0f} to {100 * figure.high:.0f}) {figure.of}"
    interval = "" if figure.low is None or figure.high is None else f" ({figure.low:.3g} to {figure.high:.3g})"
    return f"{figure.value:.4g}{interval} {figure.of}"
