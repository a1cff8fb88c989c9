"""Reading recordings for commands, and progress on stderr: a bar or a spinner."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from service.output import people

if TYPE_CHECKING:
    from telemetry.recording import Recording


def load_recording(path: Path, vehicle: str, *, as_stamped: bool = False, database: Path | None = None) -> Recording:
    """The recording of service.offline.read, with its notes on stderr."""
    from service.offline.read import read
    from vehicles.file import load

    recording, notes = read(path, load(vehicle), as_stamped=as_stamped, database=database)
    for note in notes:
        people.print(f"[yellow]{path}: {note}[/yellow]")
    return recording


@contextmanager
def working() -> Iterator[Any]:
    """A spinner with the current step, on stderr."""
    from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

    with Progress(
        SpinnerColumn(), TextColumn("{task.description}"), TimeElapsedColumn(), console=people, transient=True
    ) as progress:
        task = progress.add_task("reading")
        yield lambda text: progress.update(task, description=text)


@contextmanager
def fitting() -> Iterator[Callable[[str, str, int, int], None]]:
    """A progress bar over all fits, on stderr."""
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

    columns = (BarColumn(20), MofNCompleteColumn(), TimeElapsedColumn(), TextColumn("{task.description}"))
    with Progress(*columns, console=people, transient=True) as progress:
        task = progress.add_task("reading", total=None)

        def update(method: str, label: str, done: int, total: int) -> None:
            progress.update(task, description=f"{method}: {Path(label).name}", completed=done, total=total)

        yield update


@contextmanager
def share_done(seconds: float = math.inf) -> Iterator[Callable[[str, float], None]]:
    """A progress bar with the share that is done and the rest of `seconds`, on stderr."""
    from rich.progress import (
        BarColumn,
        Progress,
        ProgressColumn,
        Task,
        TaskProgressColumn,
        TextColumn,
        TimeElapsedColumn,
    )
    from rich.text import Text

    from estimators.budget import Budget

    class Left(ProgressColumn):
        """The maximum remaining time."""

        def render(self, task: Task) -> Text:
            return Text("" if math.isinf(seconds) else f"{budget.left:.0f} s left at most")

    budget = Budget.of(seconds)
    columns = (BarColumn(20), TaskProgressColumn(), TimeElapsedColumn(), Left(), TextColumn("{task.description}"))
    with Progress(*columns, console=people, transient=True) as progress:
        task = progress.add_task("reading", total=1.0)

        def update(text: str, share: float) -> None:
            progress.update(task, description=text, completed=share)

        yield update
