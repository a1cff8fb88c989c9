"""A comparison as text: models side by side, and where each fails."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import zip_longest
from typing import TYPE_CHECKING

from rich.console import Console
from rich.padding import Padding
from rich.table import Table
from rich.text import Text

from upright.diagnosis.report.sentences import disturbance_text
from upright.service.output import page

if TYPE_CHECKING:
    from upright.diagnosis.prediction.compare import Comparison


def print_comparisons(comparisons: Sequence[Comparison], title: str, to: Console = page) -> None:
    """Print the table of one recording, and below it where each model fails."""
    to.print(comparison_table(comparisons, title))
    for line in (*disturbance_lines(comparisons), *closed_loop_lines(comparisons)):
        to.print(Padding(Text(line), (0, 0, 0, 2)))
    for each in comparisons:
        if each.summary:
            to.print(Padding(Text(f"{each.name}:", style="bold"), (0, 0, 0, 2)))
        for sentence in each.summary:
            to.print(Padding(Text(sentence), (0, 0, 0, 4)))


def disturbance_lines(comparisons: Sequence[Comparison]) -> Iterator[str]:
    """A line per model: the random force that it does not explain."""
    for each in comparisons:
        if text := disturbance_text(each.disturbance):
            yield f"disturbance, {each.name}: {text}"


def closed_loop_lines(comparisons: Sequence[Comparison]) -> Iterator[str]:
    """A line per model: its fit if it is simulated in closed loop with the vehicle's controller."""
    reasons = {each.closed_loop.reason for each in comparisons}
    if len(reasons) == 1 and "" not in reasons:
        yield f"closed loop: not available, {reasons.pop()}"
        return
    for each in comparisons:
        loop = each.closed_loop
        fits = [f"{name} {loop.fit_percent(name):.1f} %, {loop.over_floor(name):.3g} x floor" for name in loop.measured]
        yield f"closed loop, {each.name}: {'; '.join(fits) or f'not available, {loop.reason}'}"


def comparison_table(comparisons: Sequence[Comparison], title: str = "") -> Table:
    """Models side by side: their fit some time ahead, their error over the noise floor, and the missing force (RMS)."""
    table = Table(
        title=title or None, title_justify="left", box=None, pad_edge=False, padding=(0, 1), header_style="bold"
    )
    wrapped = {"model": 8, "missing": 12}
    for heading in ("model", "channel", "fit", "error/floor", "missing", "verdict"):
        right = heading in ("fit", "error/floor", "missing")
        least = wrapped.get(heading, len("adequate") if heading == "verdict" else None)
        table.add_column(
            heading,
            justify="right" if right else "left",
            no_wrap=heading not in wrapped,
            min_width=least,
            overflow="fold",
        )
    for each in comparisons:
        forces = each.views.forces
        missing = [f"{f.rms:.3g} {f.unit}{f' at {f.joint}' if len(forces) > 1 else ''}" for f in forces]
        verdict = "[green]adequate[/green]" if each.adequate else "[red]fails[/red]"
        channels = [
            (channel, f"{fit:.2f} %", f"{each.rmse[channel] / each.noise_floor[channel]:.3g}")
            for channel, fit in each.fit_percent.items()
        ]
        names = [each.name] + [""] * (max(len(channels), len(missing)) - 1)
        for name, channel, force in zip_longest(names, channels, missing):
            table.add_row(name, *(channel or ("", "", "")), force or "", verdict if name else "")
    return table
