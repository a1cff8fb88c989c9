"""How often do the intervals of the random disturbance contain the truth, and are its estimates unbiased?

`python benchmarks/disturbance_intervals.py --records 140 --first 9000` records virtual MONOCABs of which the model
lacks nothing, with parameters drawn within the uncertainty of the vehicle file, disturbed by a random torque that is
drawn for each (2 to 20 N m RMS, 0.05 to 3 s, as in `upright benchmark hidden-effects`). It fits each recording and
counts the 95 % intervals of RMS and correlation time that contain the true value.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial
from itertools import pairwise

import numpy as np

from upright.estimators.methods.prediction_error import prediction_error
from upright.service.hidden_effects.cases import Case
from upright.service.hidden_effects.disturbances import drawn_for
from upright.service.hidden_effects.trial import WITHIN_95, Bench, disturbance_of
from upright.service.hidden_effects.vehicles import drawn
from upright.vehicles.file import load

EDGES = (0.0, 0.2, 1.0, np.inf)
"""s: limits of the classes of correlation times."""


@dataclass(frozen=True, slots=True)
class Estimated:
    """A number of the disturbance: the true value, the estimate, and its standard deviation."""

    true: float
    value: float
    std: float

    @property
    def off(self) -> float:
        """The error in standard deviations."""
        return (self.value - self.true) / self.std


@dataclass(frozen=True, slots=True)
class Record:
    """Both numbers of one record; None if the record does not show the disturbance."""

    correlation_time: float
    rms: Estimated | None
    time: Estimated | None


def tried(number: int, excitation: str, duration: float) -> Record:
    """The estimates from the record with this number."""
    bench, case = Bench(duration=duration, disturbances=drawn_for("monocab")), Case((), 0.0, 1.0, excitation, number)
    vehicle = drawn(case.seed("vehicle"))
    true, _ = disturbance_of(case, bench, vehicle)
    assert true is not None
    recording = bench.record(excitation, {}, case.noise, duration, case.seed(), vehicle, true)
    found = prediction_error(bench.nominal, [recording], support=load("monocab").support).disturbance[0]

    def estimated(true: float, value: float | None, std: float | None) -> Estimated | None:
        return None if value is None or std is None else Estimated(true, value, std)

    return Record(
        true.correlation_time,
        estimated(true.rms, found.std, found.std_error),
        estimated(true.correlation_time, found.correlation_time, found.correlation_time_error),
    )


def table(records: Sequence[Record]) -> str:
    """Coverage of the intervals, and mean and standard deviation of the normalised errors, by correlation time."""
    lines = ["correlation time  records  shown   RMS holds  mean  std    time holds  mean  std"]
    groups = [*pairwise(EDGES), (EDGES[0], EDGES[-1])]
    for low, high in groups:
        some = [each for each in records if low <= each.correlation_time < high]
        if not some:
            continue
        shown = [each for each in some if each.rms is not None]
        cells = [_held(shown, which) for which in (lambda each: each.rms, lambda each: each.time)]
        lines.append(f"{low:4g} to {high:4g} s     {len(some):6d} {len(shown):6d}   " + "    ".join(cells))
    return "\n".join(lines)


def _held(records: Sequence[Record], which: Callable[[Record], Estimated | None]) -> str:
    off = np.array([each.off for each in map(which, records) if each is not None])
    if not len(off):
        return f"{'-':>9}"
    return f"{100.0 * np.mean(np.abs(off) < WITHIN_95):7.0f} % {np.mean(off):5.2f} {np.std(off):4.2f}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--records", type=int, default=140, help="number of records")
    parser.add_argument(
        "--first", type=int, default=9000, help="number of the first record: other numbers give other draws"
    )
    parser.add_argument("--excitation", default="multisine", help="an experiment of the vehicle file")
    parser.add_argument("--duration", type=float, default=30.0, help="s, length of the experiment")
    parser.add_argument("--jobs", type=int, default=2, help="number of processes")
    chosen = parser.parse_args()
    numbers = range(chosen.first, chosen.first + chosen.records)
    one = partial(tried, excitation=chosen.excitation, duration=chosen.duration)
    records: list[Record] = []
    with ProcessPoolExecutor(chosen.jobs) as pool:
        for record in pool.map(one, numbers):
            records.append(record)
            print(f"\r{len(records)} of {len(numbers)}", end="", file=sys.stderr, flush=True)
    print(file=sys.stderr)
    print(table(records))


if __name__ == "__main__":
    main()
