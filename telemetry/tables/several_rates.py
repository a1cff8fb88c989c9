"""Channels at several rates in one table, each known in rows of its own."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from upright.telemetry.tables.matched import Matched
from upright.telemetry.tables.stamps import STEP
from upright.telemetry.tables.wanted import Wanted

TOGETHER = 0.5
"""Share of the rows in which the slowest measured channel is known, and of these rows in which all are, below which a
table has several rates."""
FASTER = 1.5
"""Times as many commands as rows from which on a row has their mean, since none of them alone acts until the next."""


def aligned(
    ns: NDArray[np.int64], found: Sequence[Matched], wanted: Sequence[Wanted]
) -> tuple[NDArray[np.bool_], dict[str, NDArray[np.float64]], list[str]]:
    """The rows (n,) that are kept, and the channels (n,) that are needed in them.

    These are the rows of the slowest measured channel, which keep their instants. A command is held until the next one,
    or is the mean until the next row if it is faster; anything else is interpolated, though not over its gaps.
    """
    needed = {each.name: each for each in wanted}
    known = {each.name: np.isfinite(each.values) for each in found if each.name in needed}
    counts = {name: int(np.count_nonzero(rows)) for name, rows in known.items()}
    measured = [name for name in known if needed[name].measured and counts[name]]
    everything = np.ones(len(ns), bool)
    if not measured or any(count == 0 for count in counts.values()):
        return everything, {}, []
    slowest = min(measured, key=counts.__getitem__)
    together = int(np.count_nonzero(np.all(list(known.values()), axis=0)))
    filled = int(np.count_nonzero(np.any(list(known.values()), axis=0)))
    if together >= TOGETHER * counts[slowest] and counts[slowest] > TOGETHER * filled:
        return everything, {}, []
    rows = known[slowest]
    time, said, columns = ns.astype(np.float64), [], {}
    for each in found:
        if each.name not in needed:
            continue
        if needed[each.name].held:
            columns[each.name] = _held(each.values, known[each.name])
            how = "held"
            if counts[each.name] > FASTER * counts[slowest]:
                columns[each.name] = _mean(time, columns[each.name], rows)
                how = "averaged"
        elif each.name != slowest:
            columns[each.name] = _between(time, each.values, known[each.name])
            how = "interpolated"
        else:
            continue
        said.append(f"{each.name} {how}")
    rate = 1e9 / float(np.median(np.diff(ns[rows]))) if counts[slowest] > 1 else 0.0
    text = f"several rates in one table: the rows are those of {slowest} ({rate:.4g} per s)"
    return rows, columns, [", ".join((text, *said))]


def _held(values: NDArray[np.float64], known: NDArray[np.bool_]) -> NDArray[np.float64]:
    last = np.maximum.accumulate(np.where(known, np.arange(len(values)), -1))
    return np.where(last >= 0, values[np.maximum(last, 0)], np.nan)


def _mean(time: NDArray[np.float64], held: NDArray[np.float64], rows: NDArray[np.bool_]) -> NDArray[np.float64]:
    """The mean of a held command from each of the `rows` to the next, in these rows."""
    impulse = np.concatenate(([0.0], np.cumsum(np.nan_to_num(held[:-1]) * np.diff(time))))
    at = np.flatnonzero(rows)
    found = held.copy()
    found[at[:-1]] = np.diff(impulse[at]) / np.diff(time[at])
    found[at[:-1][~np.isfinite(held[at[:-1]])]] = np.nan
    return found


def _between(time: NDArray[np.float64], values: NDArray[np.float64], known: NDArray[np.bool_]) -> NDArray[np.float64]:
    there, at = time[known], np.flatnonzero(known)
    found = np.interp(time, there, values[known], left=np.nan, right=np.nan)
    if len(at) < 2:
        return np.where(known, values, np.nan)
    longest = STEP * float(np.median(np.diff(there)))
    after = np.clip(np.searchsorted(there, time), 1, len(there) - 1)
    found[(there[after] - there[after - 1] > longest) & ~known] = np.nan
    return found
