"""What does a fleet cost beside its diagnoses, and do more workers help? `python benchmarks/fleet.py`

Recordings of a pendulum on a motor, each with a seed of its own, in a folder a vehicle:

    short   0.1 s, read, found too short, and said so: some 7 ms of work each, so that everything else shows
    whole   12 s at 200 Hz, diagnosed for one effect: about 2 s of work each

Each set is diagnosed by `upright fleet` on 1 worker and on W, and by W processes that get all recordings at once and
call the same diagnosis without a file, a progress or a thought of failure (multiprocessing's map). The clock starts
after a fifth of the recordings, since workers import and compile for longer than a short one takes. All are repeated in
turn, and the fastest round counts. It prints

    cost        s of a worker for each recording
    efficiency  time on 1 worker / (W x time on W workers); wanted: at least 0.9
    busy        share of the time of the W workers in which they read and diagnose
    overhead    time on W workers / time of the bare processes

`--dask` measures W workers of a Dask cluster on this machine as well. On a machine that does something else, too, the
efficiency is that of the machine; busy is not affected.
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from time import perf_counter

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests" / "support"))
sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "examples"))
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import pendulum_fleet
import pendulum_plant

from upright.service.fleet.examine import Settings, Task, examine
from upright.service.fleet.results import Row
from upright.service.fleet.run import fleet
from upright.service.fleet.store import Store
from upright.service.spread import Spread, Work, machines, processes

MODEL = pendulum_fleet.MODEL.partition("\n[[effects]]")[0]
"""Without the friction that the example begins with."""
SETS = {"short": 0.1, "whole": 12.0}
"""s of a recording, by the name of its set."""
WARM = 5
"""The part of the recordings, one in so many, after which the clock starts."""
DRAWN = 20
"""Recordings of a set that are simulated; the others are copies with other names."""


def write(folder: Path, duration: float, count: int) -> Path:
    """A folder with `count` recordings of ten vehicles."""
    texts: list[str] = []
    for number in range(count):
        path = folder / f"vehicle_{number % 10}" / f"{number:05d}.csv"
        path.parent.mkdir(parents=True, exist_ok=True)
        if number < DRAWN:
            texts.append(pendulum_plant.write(path, seed=number, duration=duration).read_text())
        path.write_text(texts[number % DRAWN])
    return folder


@dataclass(slots=True)
class Clock:
    """Counts after the first recordings: `seconds` of wall clock, for each recording, and the share of the time of the
    `workers` in which they were `busy`."""

    workers: int
    seconds: float = 0.0
    busy: float = 0.0

    def around(self, spread: Spread) -> Spread:
        """`spread` with this clock."""

        def timed(tasks: Sequence[Task], work: Work[Task, Row]) -> Iterator[Row]:
            began = worked = 0.0
            first = len(tasks) // WARM
            for number, row in enumerate(spread(tasks, work), 1):
                if number > first:
                    worked += row.seconds
                elif number == first:
                    began = perf_counter()
                yield row
            passed = perf_counter() - began
            self.seconds = passed / (len(tasks) - first)
            self.busy = worked / (self.workers * passed)

        return timed  # type: ignore[return-value]


def fleet_clock(folder: Path, settings: Settings, spread: Spread, workers: int) -> Clock:
    """`upright fleet` on a folder."""
    clock = Clock(workers)
    with tempfile.TemporaryDirectory() as out:
        found = fleet(Store.of(str(folder)), Path(out, "fleet.parquet"), settings, clock.around(spread))
    assert not found.failures, found.failures[0].reason
    return clock


def bare_seconds(folder: Path, settings: Settings, workers: int) -> float:
    """s of bare processes for each of the same recordings."""
    store = Store.of(str(folder))
    work: Callable[[Task], object] = partial(examine, settings, store)
    tasks: list[Task] = [(stored, None) for stored in store.recordings()]
    with multiprocessing.get_context("spawn").Pool(workers) as pool:
        first = len(tasks) // WARM
        pool.map(work, tasks[:first], chunksize=1)
        began = perf_counter()
        pool.map(work, tasks[first:], chunksize=1)
        return (perf_counter() - began) / (len(tasks) - first)


@contextmanager
def cluster(workers: int) -> Iterator[Spread]:
    """A Dask cluster on this machine."""
    from distributed import LocalCluster

    with LocalCluster(n_workers=workers, threads_per_worker=1, dashboard_address=None) as started:
        yield machines(started.scheduler_address)


def main() -> None:
    """Print a line for each set."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--short", type=int, default=4000, help="number of short recordings")
    parser.add_argument("--whole", type=int, default=30, help="number of whole recordings")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--rounds", type=int, default=2)
    parser.add_argument("--dask", action="store_true", help="measure a Dask cluster as well")
    chosen = parser.parse_args()
    workers: int = chosen.workers
    with tempfile.TemporaryDirectory() as temporary:
        model = Path(temporary, "pendulum.toml")
        model.write_text(MODEL)
        settings = Settings.of("monocab", str(model), effects=["viscous_friction"])
        for name, count in (("short", chosen.short), ("whole", chosen.whole)):
            if not count:
                continue
            folder = write(Path(temporary, name), SETS[name], count)
            alone, bare = Clock(1, float("inf")), float("inf")
            spreads = {"processes": processes(workers)}
            with ExitStack() as started:
                if chosen.dask:
                    spreads["Dask"] = started.enter_context(cluster(workers))
                best = {kind: Clock(workers, float("inf")) for kind in spreads}
                for _ in range(chosen.rounds):
                    alone = faster(alone, fleet_clock(folder, settings, processes(1), 1))
                    for kind, spread in spreads.items():
                        best[kind] = faster(best[kind], fleet_clock(folder, settings, spread, workers))
                    bare = min(bare, bare_seconds(folder, settings, workers))
            print(f"{count} {name}: cost {alone.seconds:.4f} s")
            for kind, clock in best.items():
                efficiency = alone.seconds / (workers * clock.seconds)
                print(
                    f"  {workers} {kind}: efficiency {efficiency:.2f}, busy {clock.busy:.3f},"
                    f" overhead {clock.seconds / bare:.3f}",
                    flush=True,
                )


def faster(one: Clock, other: Clock) -> Clock:
    """The one that took less time."""
    return min(one, other, key=lambda clock: clock.seconds)


if __name__ == "__main__":
    main()
