"""Output of commands: text and tables for users, one JSON document on stdout for scripts."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import typer
from rich.console import Console, Group
from rich.markup import escape
from rich.table import Table
from rich.text import Text

from upright.estimators.numbers import common, with_error
from upright.estimators.parting import partings

people = Console(stderr=True, highlight=False)
"""For progress, events and notes."""

page = Console(highlight=False)
"""For the result of a command as text."""


def check_folder(target: Path | None) -> None:
    """Raises BadParameter if there is no folder to write `target` to. Call it before the work, not after."""
    if target is not None and not target.absolute().parent.is_dir():
        raise typer.BadParameter(f"there is no folder {target.parent} to write {target.name} to")


def print_json(document: Any) -> None:
    """Print one JSON document on stdout; a number that is not finite becomes null."""
    typer.echo(json.dumps(_finite(document), indent=2, default=str))


def _finite(value: Any) -> Any:
    if isinstance(value, dict):
        return {str(key): _finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def parameter_table(estimates: dict[str, Any], title: str = "") -> Group:
    """Parameters with ± of one or several methods: `{method: {"parameters": {name: {value, std, unit, ...}}}}`, with
    notes below."""
    table = Table(title=title or None, title_justify="left", box=None, pad_edge=False, header_style="bold")
    # If space is limited, names of methods are wrapped, but numbers are never truncated.
    table.add_column("method", overflow="fold", min_width=12)
    for heading in ("parameter", "value", "±", "unit", ""):
        table.add_column(heading, no_wrap=True, justify="right" if heading in ("value", "±") else "left")
    notes: dict[str, list[str]] = {}
    for method, estimate in estimates.items():
        shown = method
        for name, entry in estimate["parameters"].items():
            value, std = entry.get("value"), entry.get("std")
            scale = common([(value, std)], entry.get("unit", ""))
            table.add_row(
                shown,
                name,
                *scale.pair(value, std),
                scale.unit,
                "" if value is None or not std or not value else f"{100 * std / abs(value):.2g} %",
            )
            shown = ""
            if entry.get("reason"):
                notes.setdefault(entry["reason"], []).append(name if len(estimates) == 1 else f"{name} ({method})")
        if not estimate["parameters"]:
            table.add_row(method)
        if estimate.get("reason"):
            notes.setdefault(estimate["reason"], []).append(method)
    return Group(table, *(Text(f"{', '.join(names)}: {reason}") for reason, names in notes.items()))


def live_estimates(estimates: dict[str, Any], title: str = "") -> Group:
    """The table of the live estimators' parameters, and where methods part (estimators.parting), a line each."""
    parting = [Text.assemble(("methods part", "bold"), f" {each}") for each in partings(estimates)]
    return Group(parameter_table(estimates, title), *parting)


def missing_effects(diagnosis: Mapping[str, Any] | None) -> str:
    """The result of a live diagnosis, a line for each effect."""
    if diagnosis is None:
        return ""
    if diagnosis["verdict"] == "insufficient_data":
        return f"[dim]missing effect: not known yet, {escape(diagnosis['reason'])}[/dim]"
    if not diagnosis["findings"]:
        return f"missing effect: none detected in {diagnosis['seconds']} s"
    return "\n".join(f"[bold]missing effect[/bold] {_one_effect(each)}" for each in diagnosis["findings"])


def _one_effect(finding: Mapping[str, Any]) -> str:
    sizes = ", ".join(
        f"{name.split('.')[-1]} {with_error(each['value'], each['std'], each['unit'])}"
        for name, each in finding["parameters"].items()
    )
    when = f" since {finding['since']:.0f} s" if finding["since"] else ""
    tied = f", or {', '.join(finding['tied_with'])}" if finding["tied_with"] else ""
    return f"{finding['effect']}{when}: {sizes}{tied}"
