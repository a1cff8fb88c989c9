"""Reading recordings for commands, and progress on stderr: a bar or a spinner."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.markup import escape

from upright.service.output import people

if TYPE_CHECKING:
    from upright.models.model import Model
    from upright.telemetry.recording import Recording
    from upright.telemetry.tables.mapping import Said
    from upright.vehicles.file import VehicleFile


def load_recording(path: Path, vehicle: str, *, as_stamped: bool = False) -> Recording:
    """The recording of a vehicle in a file, the longest of several; the rest is as for `load_recordings`."""
    from upright.vehicles.file import load

    return max(load_recordings([path], load(vehicle), as_stamped=as_stamped), key=len)


def load_recordings(
    paths: Sequence[Path],
    vehicle: VehicleFile,
    models: Sequence[Model] | None = None,
    *,
    user: Said | None = None,
    begin: float = 0.0,
    end: float = math.inf,
    as_stamped: bool = False,
    database: Path | None = None,
) -> list[Recording]:
    """The recordings in files of any kind, from `begin` to `end` s, for `models` (by default those of the vehicle), as
    service.offline.inputs.read has them. What was assumed to read a table of another origin is printed on stderr, and
    so is what is unusual."""
    from upright.service.offline.inputs.read import read_all

    found: list[Recording] = []
    for path in paths:
        for recording, notes in read_all(path, vehicle, models, user, as_stamped=as_stamped, database=database):
            _print_read(recording, path, notes)
            found.append(recording.between(begin, end))
    return found


def _print_read(recording: Recording, path: Path, notes: Sequence[str]) -> None:
    if recording.assumed:
        size = f"{len(recording)} samples, {recording.duration:.4g} s at {recording.rate:.4g} Hz"
        people.print(escape(f"{recording.source}: {size}. Read so:"))
        for each in recording.assumed:
            people.print(escape(f"  {each}"))
    for note in notes:
        people.print(f"[yellow]{escape(f'{path}: {note}')}[/yellow]")


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

    from upright.estimators.budget import Budget

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


@contextmanager
def counting(what: str) -> Iterator[Callable[[int, int], None]]:
    """A progress bar over all tasks, which are called `what`, with the remaining time, on stderr."""
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    columns = (
        TextColumn(what),
        BarColumn(30),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TextColumn("left"),
        # A task may take half a minute: with the default period, half a minute, the estimate would rest on one task.
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=people, speed_estimate_period=3600.0) as progress:
        task = progress.add_task(what, total=None)
        yield lambda done, total: progress.update(task, completed=done, total=total)
