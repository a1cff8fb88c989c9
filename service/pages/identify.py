"""An identification as text: methods as rows, parameters as columns, reasons below."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from rich.console import Console
from rich.padding import Padding
from rich.table import Table
from rich.text import Text

from upright.estimators.identify.document import CANCELLED
from upright.estimators.identify.rows import (
    Columns,
    disturbances,
    joint_columns,
    mean_columns,
    others,
    remarks,
    scale_of,
    sentence,
    value_text,
)
from upright.estimators.identify.table import Domain
from upright.service.output import page

GAP = 1


def print_methods(document: Mapping[str, Any], truth: Mapping[str, float], to: Console = page) -> None:
    """Print the whole page: joint estimates, means of the runs, the drives, remarks about single methods."""
    begun = {name: entry for name, entry in document["methods"].items() if entry["status"] != CANCELLED}
    methods = {name: entry for name, entry in begun.items() if entry["domain"] != Domain.DRIVES}
    if methods:
        count = len(document["recordings"])
        title = "All recordings together" if count > 1 else document["recordings"][0]["recording"]
        _print_tables(title, joint_columns(methods, document, truth), to)
        if any(mean["runs"] > 1 for entry in methods.values() for mean in entry["mean"].values()):
            _print_tables("Mean of the single recordings, ± their scatter", mean_columns(methods, document), to)
    for name, entry in begun.items():
        if entry["domain"] == Domain.DRIVES and entry["parameters"]:
            _print_drives(name, entry, to)
    for name, text in disturbances(document):
        to.print(f"\nDisturbance ({name}): {text}", markup=False)
    to.print(f"\nRecommended method: [bold]{document['best'] or 'none'}[/bold]")
    to.print(Padding(Text(sentence(document["best_reason"])), (0, 0, 0, 2)))
    for title, texts in (
        ("Why not the others", others(methods)),
        ("What the methods could not estimate", remarks(document["methods"])),
    ):
        lines = list(texts)
        if lines:
            to.print(f"\n{title}")
        for text in lines:
            to.print(Padding(Text(text), (0, 0, 0, 2)))


def _print_tables(title: str, groups: Sequence[Columns], to: Console) -> None:
    """Print one table, or several below each other if the page is too narrow; each has the methods' names."""
    names, *others = groups

    def width(columns: Columns) -> int:
        return sum(max(map(len, (*heading.split(), *cells))) + GAP for heading, *cells in columns)

    tables: list[list[Columns]] = [[names]]
    for group in others:
        if len(tables[-1]) > 1 and sum(map(width, tables[-1])) + width(group) - GAP > to.width:
            tables.append([names])
        tables[-1].append(group)
    to.print(f"\n{title}", style="bold", markup=False, soft_wrap=True)
    for part in tables:
        columns = [column for group in part for column in group]
        table = Table(box=None, pad_edge=False, padding=(0, GAP), collapse_padding=True, header_style="bold")
        for place, column in enumerate(columns):
            heading = Text("\n".join((*column[0].split(), column[1])))
            table.add_column(heading, justify="right" if place else "left", no_wrap=True)
        for row in zip(*(column[2:] for column in columns), strict=True):
            group = row[0].startswith("[")
            table.add_row(*(Text(cell.strip("[]") if group else cell) for cell in row), style="dim" if group else "")
        to.print(table)


def _print_drives(name: str, entry: Mapping[str, Any], to: Console) -> None:
    table = Table(box=None, pad_edge=False, padding=(0, 1))
    for justify in ("left", "right", "left"):
        table.add_column(justify=justify, no_wrap=True)
    for parameter, estimate in entry["parameters"].items():
        scale = scale_of([estimate], estimate["unit"])
        table.add_row(parameter, value_text(estimate, scale), scale.unit)
    to.print(f"\nDrives ({name})", style="bold", markup=False)
    to.print(table)
