"""What is wrong with time stamps, and what can be made of it: unknown, reversed, repeated, rounded, out of order, a
counter that wraps, a clock that is set, and a logger that starts anew in the middle."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from upright.telemetry.tables.times import DAY, Times

GAP = 10
"""Periods between the rows before and after a clock was set: a gap, so no fit goes across it."""
STEP = 2.5
"""Periods up to which a step of time is one from row to row."""
NEAR = 50
"""Rows by which a row out of order is away from its place."""
ROUNDED = 0.1
"""Share of repeated stamps from which on stamps are rounded throughout."""
FEWEST = 3
"""Rows of the shortest part that is kept beside others."""
_BITS = (16, 24, 31, 32)
_UNITS = (1.0, 1e-3, 1e-6)


@dataclass(frozen=True, slots=True)
class Stamped:
    """Rows with their time: `ns` int64 (n,), `values` (n, k), `lines` int64 (n,)."""

    ns: NDArray[np.int64]
    values: NDArray[np.float64]
    lines: NDArray[np.int64]

    def at(self, rows: NDArray[np.int64] | NDArray[np.bool_] | slice) -> Stamped:
        return Stamped(self.ns[rows], self.values[rows], self.lines[rows])

    def __len__(self) -> int:
        return len(self.ns)


def mended(times: Times, values: NDArray[np.float64], lines: NDArray[np.int64]) -> tuple[list[Stamped], list[str]]:
    """The parts of a table in which time rises strictly, and what was done to it."""
    said: list[str] = []
    found = Stamped(times.ns, values, lines)
    if not times.known.all():
        said.append(_rows(int(np.count_nonzero(~times.known)), "without a time", "left out", lines[~times.known][0]))
        found = found.at(times.known)
    if len(found) < 2 or np.all(np.diff(found.ns) > 0):
        return ([_closed(found, said)] if len(found) else []), said
    steps = np.diff(found.ns)
    if np.count_nonzero(steps < 0) > 2 * np.count_nonzero(steps > 0):
        found = found.at(slice(None, None, -1))
        said.append("the rows are in reverse, the newest first: turned")
    found = _without_wraps(found, times, said)
    found = _in_order(found, said)
    found = _merged(found, said)
    parts = [_even(part, said) for part in _parts(found, said)]
    long = [part for part in parts if len(part) >= FEWEST]
    if long and len(long) < len(parts):
        said.append(f"{sum(map(len, parts)) - sum(map(len, long))} rows of parts of less than {FEWEST} left out")
        parts = long
    return [_closed(part, said) for part in parts], said


def _rows(count: int, what: str, so: str, line: int) -> str:
    return f"{count} {'row' if count == 1 else 'rows'} {what} {so}, the first in line {line}"


def _period(ns: NDArray[np.int64]) -> float:
    """ns between rows."""
    steps = np.diff(ns)
    rising = steps[steps > 0]
    return float(np.median(rising)) if len(rising) else 0.0


def _without_wraps(found: Stamped, times: Times, said: list[str]) -> Stamped:
    """A counter that has come to its end goes on."""
    period, steps = _period(found.ns), np.diff(found.ns)
    if times.daily:
        ends = [1e9 * DAY]
    else:
        units = (times.resolution,) if times.resolution else _UNITS
        ends = [1e9 * 2.0**bits * unit for bits in _BITS for unit in units]
    moved, count, span = np.zeros(len(found.ns), dtype=np.int64), 0, 0.0
    for row in np.flatnonzero(steps < 0).tolist():
        for end in ends:
            on = steps[row] + end
            if end > 100.0 * period and -1e-6 * end < on <= max(STEP * period, 1e9 if times.daily else 0.0):
                moved[row + 1 :] += round(end)
                count, span = count + 1, 1e-9 * end
                break
    if not count:
        return found
    said.append(f"time: begins anew {count} times after {span:.6g} s, as a counter does: counted on")
    return replace(found, ns=found.ns + moved)


def _in_order(found: Stamped, said: list[str]) -> Stamped:
    """Rows that are a few places off are sorted, if that makes the stamps even."""
    if not (np.diff(found.ns) < 0).any():
        return found
    order = np.argsort(found.ns, kind="stable")
    off = np.abs(order - np.arange(len(order)))
    ordered = np.diff(found.ns[order])
    between = ordered[ordered > 0]
    if np.max(off) > NEAR or float(np.min(between)) < 0.3 * float(np.median(between)) or _interleaves(found, order):
        return found
    first = int(np.flatnonzero(off)[0])
    said.append(
        _rows(int(np.count_nonzero(np.diff(found.ns) < 0)), "out of order", "sorted by time", found.lines[first])
    )
    return found.at(order)


def _interleaves(found: Stamped, order: NDArray[np.int64]) -> bool:
    """Whether to sort by time would mix the rows before and after a clock was set back.

    A row that comes late breaks the order at three places; a clock that was set back, at all its rows. Rows that are
    repeated do not count.
    """
    sorted_rows = found.at(order)
    again = (np.diff(sorted_rows.ns) == 0) & np.all(
        (sorted_rows.values[1:] == sorted_rows.values[:-1]) | np.isnan(sorted_rows.values[1:]), axis=1
    )
    kept = order[np.concatenate(([True], ~again))]
    return bool(np.count_nonzero(np.diff(kept) != 1) > 3 * np.count_nonzero(np.diff(found.ns) < 0))


def _merged(found: Stamped, said: list[str]) -> Stamped:
    """Rows with the same time are one row, if none contradicts another."""
    same = np.concatenate(([False], np.diff(found.ns) == 0))
    if not same.any():
        return found
    values, keep = found.values.copy(), np.ones(len(found), bool)
    repeated = joined = 0
    last = 0
    for row in range(1, len(values)):
        if not same[row]:
            last = row
            continue
        here, before = values[row], values[last]
        both = np.isfinite(here) & np.isfinite(before)
        if np.array_equal(here[both], before[both]) and (both.any() or np.isfinite(here).any() or not len(here)):
            if np.array_equal(here, before, equal_nan=True):
                repeated += 1
            else:
                joined += 1
                values[last] = np.where(np.isfinite(before), before, here)
            keep[row] = False
        else:
            last = row
    if (repeated and 2 * repeated > np.count_nonzero(same)) or (repeated and joined):
        said.append(f"{repeated} {'row is' if repeated == 1 else 'rows are'} repeated and left out")
    elif repeated:
        # At rest, values repeat while a rounded clock stands: these rows are samples like the others.
        keep, values = np.ones(len(found), bool), found.values
        joined = 0
    if joined:
        said.append(f"{joined} rows with the same time are joined: each has other channels")
    return replace(found, values=values).at(keep)


def _parts(found: Stamped, said: list[str]) -> list[Stamped]:
    """The table, cut where the logger began anew, with the clock put right where it was set."""
    ns, period = found.ns.copy(), _period(found.ns)
    begins = [0]
    for row in (np.flatnonzero(np.diff(found.ns) < 0) + 1).tolist():
        if ns[row] <= ns[begins[-1]] + GAP * period:
            said.append(f"time: begins anew in line {found.lines[row]}: another recording")
            begins.append(row)
            continue
        back = float(ns[row - 1] - ns[row])
        ns[row:] += round(back + GAP * period)
        by, line = 1e-9 * (back + period), found.lines[row]
        said.append(f"time: set back by {by:.4g} s in line {line}: read as a gap of {GAP} samples")
    moved = replace(found, ns=ns)
    return [moved.at(slice(a, b)) for a, b in zip(begins, [*begins[1:], len(ns)], strict=True)]


def _even(found: Stamped, said: list[str]) -> Stamped:
    """Repeated stamps are rounded ones: the rows are spread evenly between them."""
    if len(found) < 2:
        return found
    same = np.diff(found.ns) == 0
    if not same.any():
        return found
    period = _period(found.ns)
    if period == 0.0:
        return found.at(slice(0, 1))
    rows = np.arange(len(found), dtype=np.float64)
    starts = np.concatenate(([0], np.flatnonzero(~same) + 1))
    since = (found.ns - found.ns[0]).astype(np.float64)
    if np.mean(same) > ROUNDED and len(starts) > 2:
        slope, begin = np.polyfit(rows[starts[1:]], since[starts[1:]], 1)
        if np.ptp(since - begin - slope * rows) <= 1.5 * period:
            apart = f"the rows are {1e-9 * slope:.6g} s apart on average, and evenly"
            said.append(f"time: rounded to {1e-9 * period:.4g} s: {apart}")
            return replace(found, ns=found.ns[0] + np.round(slope * rows).astype(np.int64))
    counts = np.diff(np.append(starts, len(since)))
    nexts = np.append(since[starts[1:]], since[-1] + period)
    spans = np.minimum(nexts - since[starts], STEP * period)
    place = rows - np.repeat(starts, counts)
    spread = np.repeat(since[starts], counts) + np.repeat(spans / counts, counts) * place
    said.append(f"{np.count_nonzero(same)} time stamps are repeated: these rows are spread evenly up to the next stamp")
    ns = found.ns[0] + np.round(spread).astype(np.int64)
    rises = np.concatenate(([True], np.diff(ns) > 0))
    return replace(found, ns=ns).at(rises)


def _closed(found: Stamped, said: list[str]) -> Stamped:
    """A step forward that is longer than all else is a clock that was set: it becomes a gap."""
    steps = np.diff(found.ns).astype(np.float64)
    if len(steps) < GAP:
        return found
    period, longest = float(np.median(steps)), int(np.argmax(steps))
    others = float(np.sum(steps) - steps[longest])
    if not (steps[longest] > others and steps[longest] > 1000.0 * period):
        return found
    ns = found.ns.copy()
    ns[longest + 1 :] -= round(steps[longest] - GAP * period)
    by, line = 1e-9 * steps[longest], found.lines[longest + 1]
    said.append(f"time: set forward by {by:.4g} s in line {line}: read as a gap of {GAP} samples")
    return replace(found, ns=ns)
