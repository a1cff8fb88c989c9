"""The tables of a file as recordings."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from upright.telemetry.errors import RecordingError
from upright.telemetry.options import mapped
from upright.telemetry.recording import Recording, describe
from upright.telemetry.tables.mapping import NOTHING, Said
from upright.telemetry.tables.matched import Matched, matched
from upright.telemetry.tables.raw import RawTable
from upright.telemetry.tables.several_clocks import joined, with_one_clock
from upright.telemetry.tables.several_rates import aligned
from upright.telemetry.tables.stamps import Stamped, mended
from upright.telemetry.tables.times import times_of
from upright.telemetry.tables.wanted import Wanted


def recordings(
    tables: Sequence[RawTable], wanted: Sequence[Wanted] = (), user: Said = NOTHING
) -> tuple[Recording, ...]:
    """The recordings in the tables of a file, which are joined: one, or several if the logger began anew.

    `wanted` are the channels that are needed, which are found by their names and converted to their units; `user` is
    what the user says of the columns. What was assumed is in `Recording.assumed`. Raises RecordingError.
    """
    table = joined(tables, wanted, user)
    if len(table) == 0:
        raise RecordingError(table.source, "", "holds no rows", remedy="Record again, for longer.")
    if not table.columns:
        raise RecordingError(table.source, "", "has no columns of numbers", remedy="Record again, or add some columns.")
    if not user.columns.get("time"):
        table = with_one_clock(table, wanted)
    times = times_of(table, user)
    channels, said = matched(table, wanted, user, times.columns)
    if not channels:
        raise RecordingError(table.source, "", "holds no channels", remedy="Record again, or add some columns.")
    said = [*table.said, *filter(None, [times.said]), *said]
    channels = [_finite(each, said) for each in channels]
    if len(times.ns) > 1 and times.known.all() and not np.ptp(times.ns):
        remedy = f"Name another column; if the rows are evenly spaced, {mapped({'time': 'row:0.01'})} for 0.01 s."
        raise RecordingError(table.source, "time", "is the same in all rows", remedy=remedy)
    stack = np.stack([each.values for each in channels], axis=1)
    parts, done = mended(times, stack, table.lines)
    said += done
    if not parts:
        remedy = f"Name another column: {mapped({'time': 'COLUMN:s'})}."
        raise RecordingError(table.source, "time", "has values that are not numbers, in all rows", remedy=remedy)
    count = len(parts)
    found = (_recording(table, channels, part, wanted, said, place, count) for place, part in enumerate(parts))
    return tuple(replace(each, settled=user.settled) for each in found)


def longest(found: Sequence[Recording]) -> Recording:
    """The longest of the recordings in a table, which then states that there are others."""
    if len(found) == 1:
        return found[0]
    note = f"there are {len(found)} recordings, since time begins anew: this is the longest"
    chosen = max(found, key=len)
    return replace(chosen, assumed=(*chosen.assumed, note))


def _finite(channel: Matched, said: list[str]) -> Matched:
    """The channel, in which what is infinite is not known."""
    infinite = np.isinf(channel.values)
    if not infinite.any():
        return channel
    count = np.count_nonzero(infinite)
    said.append(f"{channel.name}: {count} infinite {'value is' if count == 1 else 'values are'} not known")
    return replace(channel, values=np.where(infinite, np.nan, channel.values))


def _recording(
    table: RawTable,
    channels: Sequence[Matched],
    part: Stamped,
    wanted: Sequence[Wanted],
    said: Sequence[str],
    place: int,
    count: int,
) -> Recording:
    here = [replace(each, values=part.values[:, column].copy()) for column, each in enumerate(channels)]
    rows, changed, more = aligned(part.ns, here, wanted)
    values = {each.name: changed.get(each.name, each.values)[rows] for each in here}
    names = {each.name: each.unit for each in here}
    rest, resting = _at_rest(values, wanted, int(np.count_nonzero(rows)))
    return Recording(
        channels=describe({**names, **{each.name: each.unit for each in rest}}),
        timestamp_ns=part.ns[rows],
        values={**values, **{each.name: np.zeros(int(np.count_nonzero(rows))) for each in rest}},
        metadata=table.metadata,
        truncated=table.truncated,
        source=table.source if count == 1 else f"{table.source} (part {place + 1} of {count})",
        assumed=(*said, *more, *resting),
    )


def _at_rest(values: dict[str, np.ndarray], wanted: Sequence[Wanted], rows: int) -> tuple[list[Wanted], list[str]]:
    """The channels of parts that the vehicle does not have, if the table is of that vehicle."""
    if not any(each.name in values for each in wanted if not each.part):
        return [], []
    found, said = [], []
    for part in dict.fromkeys(each.part for each in wanted if each.part):
        channels = [each for each in wanted if each.part == part]
        if rows and not any(each.name in values for each in channels):
            found += channels
            said.append(f"{', '.join(each.name for each in channels)}: not there, so the {part} is at rest at 0")
    return found, said
