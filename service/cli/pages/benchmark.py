"""The figures of the benchmark as text: methods side by side, each figure with its interval and number of cases."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING

from upright.service.output import page

if TYPE_CHECKING:
    from upright.service.hidden_effects.results.summary import Figure, Merit, Summary

Row = tuple[str, str, "Callable[[Merit], Figure | None]", bool]
"""Heading, target value, the figure of a method, whether it is a share."""


def print_summary(summary: Summary) -> None:
    """Print all figures as a table, then the minimum detectable sizes and the number of cases by status."""
    from rich.table import Table

    if not summary.methods:
        page.print("No case is finished.")
    else:
        table = Table(box=None, pad_edge=False, padding=(0, 2, 0, 0), header_style="bold", title_justify="left")
        table.add_column("figure")
        table.add_column("target", justify="right")
        for name in summary.methods:
            table.add_column(name)
        for heading, target, figure, percent in _rows(summary):
            cells = [_cell(figure(merit), percent) for merit in summary.methods.values()]
            table.add_row(heading, target, *cells)
        page.print(table)
        page.print("Value (95 % interval) number of cases. Detectable: twice the minimum detectable effect or more.")
    for conditions, sizes in summary.detectable.items():
        minima = ", ".join(f"{effect} {size:.3g}" for effect, size in sizes.items())
        page.print(f"Minimum detectable effects with {conditions}: {minima}")
    counts = ", ".join(f"{count} {status}" for status, count in summary.cases.items())
    page.print(f"Cases ({summary.conditions or 'none'}): {counts or 'none'}")


def _rows(summary: Summary) -> Iterator[Row]:
    merits = list(summary.methods.values())

    def keys(of: Callable[[Merit], object]) -> list[str]:
        return list(dict.fromkeys(key for merit in merits for key in of(merit)))  # type: ignore[attr-defined]

    yield "right name first, or tied with one: detectable", ">= 97 %", lambda merit: merit.right_seen, True
    for size in sorted(keys(lambda merit: merit.right), key=float):
        yield f"  at {size} times the minimum", "", lambda merit, size=size: merit.right.get(size), True  # type: ignore[misc]
    for name in keys(lambda merit: merit.right_by_excitation):
        yield f"  with {name}", "", lambda merit, name=name: merit.right_by_excitation.get(name), True  # type: ignore[misc]
    for name in keys(lambda merit: merit.right_by_disturbance):
        yield f"  with disturbance {name}", "", lambda merit, name=name: merit.right_by_disturbance.get(name), True  # type: ignore[misc]
    yield "  verdict unknown", "", lambda merit: merit.seen_unknown, True
    for name in keys(lambda merit: merit.seen_unknown_by_disturbance):
        title = f"    with disturbance {name}"
        yield title, "", lambda merit, name=name: merit.seen_unknown_by_disturbance.get(name), True  # type: ignore[misc]
    yield "false alarms", "<= 1 %", lambda merit: merit.false_alarms_all, True
    for name in keys(lambda merit: merit.false_alarms):
        yield f"  with {name}", "", lambda merit, name=name: merit.false_alarms.get(name), True  # type: ignore[misc]
    for name in keys(lambda merit: merit.false_alarms_by_disturbance):
        title = f"  with disturbance {name}"
        yield title, "", lambda merit, name=name: merit.false_alarms_by_disturbance.get(name), True  # type: ignore[misc]
    yield "records with a false name", "<= 1 %", lambda merit: merit.false_names, True
    yield "  not called negligible", "<= 1 %", lambda merit: merit.false_names_that_matter, True
    yield "not in the catalogue: verdict unknown", ">= 90 %", lambda merit: merit.unlisted_unknown, True
    yield "  given a name", "<= 5 %", lambda merit: merit.unlisted_misnamed, True
    yield "two effects: both named, detectable", ">= 80 %", lambda merit: merit.both_seen, True
    for size in sorted(keys(lambda merit: merit.both), key=float):
        yield f"  at {size} times the minimum", "", lambda merit, size=size: merit.both.get(size), True  # type: ignore[misc]
    for name in keys(lambda merit: merit.both_by_disturbance):
        yield f"  with disturbance {name}", "", lambda merit, name=name: merit.both_by_disturbance.get(name), True  # type: ignore[misc]
    yield "excess held-out error removed, median", ">= 0.99", lambda merit: merit.held_out_closed, False
    yield "error energy over the right model's, median", "<= 1.01", lambda merit: merit.energy_over_floor, False
    yield "coverage of 95 % intervals", "93 to 97 %", lambda merit: merit.covered, True
    for name in keys(lambda merit: merit.disturbance_covered):
        title = f"  of the disturbance's {name.replace('_', ' ')}"
        yield title, "93 to 97 %", lambda merit, name=name: merit.disturbance_covered.get(name), True  # type: ignore[misc]
        title = "    if all hidden effects are named"
        yield title, "93 to 97 %", lambda merit, name=name: merit.disturbance_covered_named.get(name), True  # type: ignore[misc]
    yield "seconds per diagnosis, median", "", lambda merit: merit.seconds, False


def _cell(figure: Figure | None, percent: bool) -> str:
    if figure is None or figure.value is None:
        return "-"
    if percent:
        assert figure.low is not None
        assert figure.high is not None
        return f"{100 * figure.value:.0f} % ({100 * figure.low:.0f} to {100 * figure.high:.0f}) {figure.of}"
    interval = "" if figure.low is None or figure.high is None else f" ({figure.low:.3g} to {figure.high:.3g})"
    return f"{figure.value:.4g}{interval} {figure.of}"
