"""Diagnose the recordings of a fleet that are new or changed, and keep every result that is finished."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from fnmatch import fnmatch
from functools import partial
from importlib.metadata import version
from pathlib import Path
from time import perf_counter

from upright.service.fleet import results
from upright.service.fleet.examine import Settings, Task, examine, failed
from upright.service.fleet.results import DONE, Row
from upright.service.fleet.store import Store, Stored, StoreError
from upright.service.spread import Spread, Work

WRITING = 0.02
"""Maximum share of the time in which the file of the results is written, which is written whole each time."""


@dataclass(frozen=True, slots=True)
class Fleet:
    """The rows of all recordings that are finished, by name; `skipped` of them are from before. `missing` recordings
    are not finished, since the run was interrupted."""

    rows: tuple[Row, ...]
    skipped: int
    missing: int

    @property
    def failures(self) -> tuple[Row, ...]:
        """The recordings that could not be read or diagnosed."""
        return tuple(row for row in self.rows if row.status != DONE)


def fleet(
    store: Store,
    out: Path,
    settings: Settings,
    spread: Spread,
    *,
    only: str = "*",
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> Fleet:
    """Diagnose the recordings of `store` that match `only`, and write a row for each to the Parquet file `out`, beside
    those that it has of the others.

    A recording is skipped if it has a row there, made by these `settings` and this version of the program of the same
    bytes; one that failed is tried again. `progress` gets the number of finished recordings and of all. Ctrl-C ends the
    run with what is finished. Raises StoreError, ResultsError, SchedulerError, OSError.
    """
    stored = store.recordings(besides=out)
    wanted = [each for each in stored if fnmatch(each.name, only)]
    if not wanted:
        raise StoreError(store.url, f"holds no recording that matches {only}", remedy="give another pattern: --only.")
    before = {row.recording: row for row in results.read(out) if _is_of(row, settings)} if out.exists() else {}
    rows = {each.name: before[each.name] for each in stored if _is_unchanged(each, before)}
    tasks: list[Task] = [(each, before.get(each.name)) for each in wanted if each.name not in rows]
    work = Work(partial(examine, settings, store), partial(failed, settings))
    file = _File(out, stored, rows)
    skipped = done = len(wanted) - len(tasks)
    progress(done, len(wanted))
    try:
        for row in spread(tasks, work):
            rows[row.recording] = row
            file.write_if_due()
            done += 1
            progress(done, len(wanted))
    except KeyboardInterrupt:
        pass
    finally:
        if done > skipped or not tasks:
            file.write()
    finished = tuple(rows[each.name] for each in wanted if each.name in rows)
    return Fleet(finished, skipped, len(wanted) - done)


class _File:
    """The file of the results, with the `rows` by name in the order of the recordings."""

    def __init__(self, path: Path, order: Sequence[Stored], rows: dict[str, Row]) -> None:
        self._path, self._order, self._rows = path, order, rows
        self._due = 0.0

    def write_if_due(self) -> None:
        if perf_counter() >= self._due:
            self.write()

    def write(self) -> None:
        began = perf_counter()
        results.write(self._path, [self._rows[each.name] for each in self._order if each.name in self._rows])
        ended = perf_counter()
        self._due = ended + (ended - began) / WRITING


def _is_of(row: Row, settings: Settings) -> bool:
    return row.status == DONE and row.settings == settings.everything and row.version == version("upright")


def _is_unchanged(stored: Stored, before: dict[str, Row]) -> bool:
    return stored.name in before and before[stored.name].stamp == stored.stamp
