"""An estimate as people like to read it: value, +-, unit, what is not known and why, and what goes along with what."""

from __future__ import annotations

from html import escape
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from estimators.contract import Estimate

WORTH_TELLING = 0.9
"""Correlations from here on are told."""


def as_text(estimate: Estimate) -> str:
    """Several lines, for a terminal."""
    rows = [_cells(name, estimate) for name in estimate.parameters]
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)] if rows else []
    lines = [_headline(estimate)]
    lines += ["  " + "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)) for row in rows]
    return "\n".join(line.rstrip() for line in [*lines, *("  " + note for note in _notes(estimate))])


def as_html(estimate: Estimate) -> str:
    """A table, for a notebook."""
    rows = "".join(
        "<tr>"
        + "".join(f"<td style='text-align:left'>{escape(cell)}</td>" for cell in _cells(name, estimate))
        + "</tr>"
        for name in estimate.parameters
    )
    notes = "".join(f"<div>{escape(note)}</div>" for note in _notes(estimate))
    head = "<tr><th>parameter</th><th>value</th><th>+-</th><th>unit</th><th></th></tr>"
    return f"<div><b>{escape(_headline(estimate))}</b><table>{head}{rows}</table>{notes}</div>"


def _headline(estimate: Estimate) -> str:
    state = "" if estimate.status.value == "ok" else f" [{estimate.status.value}: {estimate.reason}]"
    return f"{estimate.method}: {estimate.samples} samples, {estimate.span:.1f} s, took {estimate.seconds:.2f} s{state}"


def _cells(name: str, estimate: Estimate) -> tuple[str, str, str, str, str]:
    parameter = estimate.parameters[name]
    if parameter.value is None or parameter.std is None:
        return name, "-", "", parameter.unit, f"{parameter.status.value}: {parameter.reason}"
    digits = significant(parameter.std)
    return name, f"{parameter.value:.{digits}f}", f"+- {parameter.std:.{digits}f}", parameter.unit, parameter.reason


def significant(std: float) -> int:
    """Decimals with which a value of this standard deviation is written: two digits of the deviation."""
    if not 0.0 < std < np.inf:
        return 3
    return int(np.clip(1 - np.floor(np.log10(std)), 0, 12))


def _notes(estimate: Estimate) -> list[str]:
    notes = [f"predicts {channel}: {percent:.2f} %" for channel, percent in estimate.fit_percent.items()]
    notes += [f"{name} is at its bound" for name in estimate.bounds_hit]
    if estimate.correlation is not None:
        names = list(estimate.parameters)
        size = np.abs(np.nan_to_num(np.tril(estimate.correlation, -1)))
        for row, column in sorted(np.argwhere(size > WORTH_TELLING).tolist(), key=lambda at: -size[at[0], at[1]]):
            notes.append(f"{names[column]} and {names[row]} go together: {estimate.correlation[row, column]:+.3f}")
    return notes
