"""How `upright identify` shows its document to people: methods as rows, parameters as columns, reasons below."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from rich.padding import Padding
from rich.table import Table
from rich.text import Text

from estimators.method_document import CANCELLED
from estimators.method_table import Domain
from estimators.report import significant
from service.cli.output import page

NUISANCES = frozenset({"drive_offset", "setpoint_offset", "drive_time_offset"})
"""Fitted along so that they do not bias the rest; no property of the vehicle. In the JSON they are."""

Columns = list[list[str]]
"""Column by column, each with heading and unit first; a heading takes a line a word."""
GAP = 1


def print_methods(document: Mapping[str, Any], truth: Mapping[str, float]) -> None:
    """The whole page: joint estimates, the runs' means, the drives, what is to be said of single methods."""
    begun = {name: entry for name, entry in document["methods"].items() if entry["status"] != CANCELLED}
    methods = {name: entry for name, entry in begun.items() if entry["domain"] != Domain.DRIVES}
    if methods:
        count = len(document["recordings"])
        title = "All recordings together" if count > 1 else document["recordings"][0]["recording"]
        _print_tables(title, _joint(methods, document, truth))
        if any(mean["runs"] > 1 for entry in methods.values() for mean in entry["mean"].values()):
            _print_tables("Mean of the single recordings, ± their scatter", _means(methods, document))
    for name, entry in begun.items():
        if entry["domain"] == Domain.DRIVES and entry["parameters"]:
            _print_drives(name, entry)
    if document["best"]:
        page.print(f"\nTo rely on: [bold]{document['best']}[/bold]")
    for text in _remarks(document["methods"]):
        page.print(Padding(Text(text), (0, 0, 0, 2)))


def shown_parameters(methods: Mapping[str, Mapping[str, Any]]) -> dict[str, str]:
    """Name to unit of the parameters that any of `methods` is asked for, nuisances apart."""
    return {
        name: entry["unit"]
        for method in methods.values()
        for name, entry in method["parameters"].items()
        if name not in NUISANCES
    }


def _joint(methods: Mapping[str, Any], document: Mapping[str, Any], truth: Mapping[str, float]) -> list[Columns]:
    before = document["before"]
    rows: list[tuple[str, Mapping[str, Any] | None]] = [("CAD", {"parameters": before})]
    if truth:
        rows.append(("truth", {"parameters": {name: {"value": value} for name, value in truth.items()}}))
    rows += list(_grouped(methods))
    groups: list[Columns] = [[["method", "", *(name for name, _ in rows)]]]
    for name, unit in shown_parameters(methods).items():
        entries = [(row or {}).get("parameters", {}).get(name) for _, row in rows]
        groups.append(_value_columns(name, unit, entries, before.get(name)))
    heading = "fit" if document["fit_measured_alike"] else "own fit"
    fits = [min(entry.get("fit_percent", {}).values(), default=None) if entry else None for _, entry in rows]
    seconds = [entry.get("seconds") or None if entry else None for _, entry in rows]
    groups.append([[heading, "%", *(_number(fit, 1) for fit in fits)]])
    groups.append([["took", "s", *(_number(each, 1) for each in seconds)]])
    return groups


def _means(methods: Mapping[str, Any], document: Mapping[str, Any]) -> list[Columns]:
    rows = list(_grouped({name: entry for name, entry in methods.items() if entry["mean"]}))
    groups: list[Columns] = [[["method", "", *(name for name, _ in rows)]]]
    for name, unit in shown_parameters(methods).items():
        entries = [entry["mean"].get(name) if entry else None for _, entry in rows]
        groups.append(_value_columns(name, unit, entries, document["before"].get(name)))
    counts = [max((mean["runs"] for mean in entry["mean"].values()), default=0) if entry else None for _, entry in rows]
    groups.append([["runs", "", *("" if count is None else str(count) for count in counts)]])
    return groups


def _grouped(methods: Mapping[str, Any]) -> Iterator[tuple[str, Mapping[str, Any] | None]]:
    """The methods, each group of them under its name."""
    for domain in Domain:
        inside = {name: entry for name, entry in methods.items() if entry["domain"] == domain}
        if inside:
            yield f"[{domain.value}]", None
            yield from inside.items()


def _value_columns(
    name: str, unit: str, entries: Sequence[Mapping[str, Any] | None], before: Mapping[str, Any] | None
) -> Columns:
    """Value and standard deviation, and, where it is known from before, the deviation from that in percent."""
    words = name.replace(".", "_").split("_")
    columns = [[" ".join(dict.fromkeys(words)), unit, *map(_value, entries)]]
    if before is not None:
        values = [entry.get("value") if entry else None for entry in entries]
        changes = ["" if v in (None, before["value"]) else f"{100 * (v / before['value'] - 1):+.1f}" for v in values]
        columns.append(["vs CAD", "%", *changes])
    return columns


def _value(entry: Mapping[str, Any] | None) -> str:
    if entry is None:
        return ""
    value, std = entry.get("value"), entry.get("std")
    if value is None:
        return "-"
    if std is None:
        return f"{value:.6g}"
    digits = significant(std)
    return f"{value:.{digits}f} ±{std:.{digits}f}"


def _number(value: float | None, digits: int) -> str:
    return "" if value is None else f"{value:.{digits}f}"


def _print_tables(title: str, groups: Sequence[Columns]) -> None:
    """As many tables below each other as the page is too narrow for one; the methods' names are in each."""
    names, *others = groups

    def width(columns: Columns) -> int:
        return sum(max(map(len, (*heading.split(), *cells))) + GAP for heading, *cells in columns)

    tables: list[list[Columns]] = [[names]]
    for group in others:
        if len(tables[-1]) > 1 and sum(map(width, tables[-1])) + width(group) - GAP > page.width:
            tables.append([names])
        tables[-1].append(group)
    page.print(f"\n{title}", style="bold", markup=False, soft_wrap=True)
    for part in tables:
        columns = [column for group in part for column in group]
        table = Table(box=None, pad_edge=False, padding=(0, GAP), collapse_padding=True, header_style="bold")
        for place, column in enumerate(columns):
            heading = Text("\n".join((*column[0].split(), column[1])))
            table.add_column(heading, justify="right" if place else "left", no_wrap=True)
        for row in zip(*(column[2:] for column in columns), strict=True):
            group = row[0].startswith("[")
            table.add_row(*(Text(cell.strip("[]") if group else cell) for cell in row), style="dim" if group else "")
        page.print(table)


def _print_drives(name: str, entry: Mapping[str, Any]) -> None:
    table = Table(box=None, pad_edge=False, padding=(0, 1))
    for justify in ("left", "right", "left"):
        table.add_column(justify=justify, no_wrap=True)
    for parameter, told in entry["parameters"].items():
        table.add_row(parameter, _value(told), told["unit"])
    page.print(f"\nDrives ({name})", style="bold", markup=False)
    page.print(table)


def _remarks(methods: Mapping[str, Mapping[str, Any]]) -> Iterator[str]:
    """What is to be said of single methods; those of which the same is to be said, together."""
    said: dict[tuple[str, str], list[str]] = {}
    for name, entry in methods.items():
        whole = entry["reason"]
        if whole or entry["status"] != "ok":
            state = "" if entry["status"] == "ok" else f"{entry['status'].replace('_', ' ')}: "
            said.setdefault(("", f"{state}{whole}"), []).append(name)
        for parameter, told in entry["parameters"].items():
            if parameter not in NUISANCES and told.get("reason") not in (None, "", whole):
                said.setdefault((parameter, told["reason"]), []).append(name)
    for (parameter, reason), names in said.items():
        yield f"{', '.join(names)}: {f'{parameter}: ' if parameter else ''}{reason}"
