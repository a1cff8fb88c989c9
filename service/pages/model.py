"""A model as text: tables of a model's parts, and its equations."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from math import isinf
from typing import Any

from rich.console import Console
from rich.table import Table
from rich.text import Text

from upright.estimators.numbers import Scale, common
from upright.models.model import Model
from upright.models.parts import Hold, Parameter
from upright.models.rendering import text
from upright.service.output import page

WIDE = 110
"""Columns that a table of parameters with their meaning needs."""
_BETWEEN = {Hold.ZERO_ORDER: "held", Hold.CUBIC: "cubic"}


def print_model(shown: Model, history: Iterable[Mapping[str, Any]], to: Console = page) -> None:
    """Print everything about `shown`, and its history."""
    to.print(f"{shown.name}: {shown.title}", markup=False, style="bold", soft_wrap=True)
    if shown.source:
        to.print(f"Source: {shown.source}", markup=False, soft_wrap=True)
    _print(
        "states", ("unit", "starts at", "meaning"), [(s.name, s.unit, s.initial, s.meaning) for s in shown.states], to
    )
    inputs = [(each.name, each.unit, _BETWEEN[each.hold], each.meaning) for each in shown.inputs]
    _print("inputs", ("unit", "between samples", "meaning"), inputs, to)
    outputs = [(each.name, each.unit, f"{each.noise:.2g}", each.meaning) for each in shown.outputs]
    _print("outputs", ("unit", "noise", "meaning"), outputs, to)
    to.print("\nequations", style="bold")
    to.print(text(shown), markup=False, soft_wrap=True)
    to.print()
    print_parameters(shown.parameters, to)
    effects = [(each.name, each.at, each.effect.family.value, each.effect.equation) for each in shown.effects]
    _print("effects", ("at", "family", "equation"), effects, to)
    if (actuators := shown.actuators_model) is not None:
        to.print(f"\nThe actuators have a model of their own, {actuators.name}:", markup=False, soft_wrap=True)
        print_parameters([each for effect in actuators.effects for each in effect.parameters], to)
    entries = [(str(each.get("date", "")), each["action"], each.get("effect", ""), _rest(each)) for each in history]
    _print("history", ("action", "effect", ""), entries, to)


def print_parameters(parameters: Sequence[Parameter], to: Console = page) -> None:
    """Print parameters with bounds, whether they are estimated, and their meaning, beside or below."""
    rows = []
    for each in parameters:
        scale = common([(each.value, each.std)], each.unit)
        known = "estimated" if each.estimated else "known"
        rows.append((each.name, *scale.pair(each.value, each.std), scale.unit, _bounds(each, scale), known))
    headings, meanings = ("value", "±", "unit", "bounds", ""), [each.meaning for each in parameters]
    if to.width >= WIDE:
        rows_with_meaning = [(*row, meaning) for row, meaning in zip(rows, meanings, strict=True)]
        to.print(_table("parameters", (*headings, "meaning"), rows_with_meaning))
    else:
        to.print(_table("parameters", headings, rows))
        _print("parameters", ("meaning",), [(e.name, e.meaning) for e in parameters if e.meaning], to)


def _bounds(parameter: Parameter, scale: Scale) -> str:
    lower, upper = (f"{bound / 10.0**scale.power:.4g}" for bound in (parameter.lower, parameter.upper))
    match isinf(parameter.lower), isinf(parameter.upper):
        case True, True:
            return ""
        case False, True:
            return f">= {lower}"
        case True, False:
            return f"<= {upper}"
        case _:
            return f"{lower} .. {upper}"


def _rest(entry: Mapping[str, Any]) -> str:
    left_out = ("date", "action", "effect", "sha256", "held_out_sha256", "values_before", "values_after")
    return ", ".join(f"{key} {_words(value)}" for key, value in entry.items() if key not in left_out)


def _words(value: Any) -> str:
    match value:
        case Mapping():
            return ", ".join(f"{key} {_words(item)}" for key, item in value.items())
        case list() | tuple():
            return ", ".join(map(_words, value))
        case _:
            return str(value)


def _print(title: str, headings: tuple[str, ...], rows: Sequence[tuple[str, ...]], to: Console) -> None:
    if rows:
        to.print()
        to.print(_table(title, headings, rows))


def _table(title: str, headings: tuple[str, ...], rows: Sequence[tuple[str, ...]]) -> Table:
    """A table of which only the last column is wrapped."""
    table = Table(box=None, pad_edge=False, header_style="bold")
    for heading in (title, *headings[:-1]):
        table.add_column(heading, no_wrap=True, justify="right" if heading in ("value", "±") else "left")
    table.add_column(headings[-1])
    for row in rows:
        table.add_row(*map(Text, row))
    return table
