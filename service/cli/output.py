"""How commands print: people read stderr and tables, scripts read one JSON document on stdout."""

from __future__ import annotations

import json
import math
from typing import Any

import typer
from rich.console import Console
from rich.table import Table

people = Console(stderr=True, highlight=False)
"""Where progress, events and notes go."""

page = Console(highlight=False)
"""Where the answer of a command goes, when it is for people."""


def print_json(document: Any) -> None:
    """One JSON document on stdout; a number that is not finite becomes null."""
    typer.echo(json.dumps(_finite(document), indent=2, default=str))


def _finite(value: Any) -> Any:
    if isinstance(value, dict):
        return {str(key): _finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def parameter_table(estimates: dict[str, Any], title: str = "") -> Table:
    """Parameters with +- of one or several methods: `{method: {"parameters": {name: {value, std, unit, ...}}}}`."""
    table = Table(title=title or None, title_justify="left", box=None, pad_edge=False, header_style="bold")
    for heading in ("method", "parameter"):
        table.add_column(heading, no_wrap=True)
    for heading in ("value", "±", "unit", "", "note"):
        table.add_column(heading, justify="right" if heading in ("value", "±") else "left")
    for method, estimate in estimates.items():
        shown = method
        for name, entry in estimate["parameters"].items():
            value, std = entry.get("value"), entry.get("std")
            table.add_row(
                shown,
                name,
                "-" if value is None else f"{value:.5g}",
                "-" if std is None else f"{std:.2g}",
                entry.get("unit", ""),
                "" if value is None or not std or not value else f"{100 * std / abs(value):.2g} %",
                entry.get("reason", "") or "",
            )
            shown = ""
        if estimate.get("reason"):
            table.add_row(shown, "", "", "", "", "", estimate["reason"])
    return table
