"""Measurement files of ASAM MDF 3 and 4 (asammdf, the extra `upright[mf4]`): a table for each channel group.

A bus log in this format is read by service.offline.inputs.can_log.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from traceback import clear_frames
from typing import Any

import numpy as np

from upright.telemetry.formats.columns import seconds, table_of
from upright.telemetry.tables.raw import Column, RawTable


def read(path: Path) -> Sequence[RawTable]:
    """A table for each channel group over time. Raises OSError, and what asammdf raises."""
    tables = []
    with opened(path) as file:
        names = Counter(channel.name for group in file.groups for channel in group.channels)
        for place in range(len(file.groups)):
            table = _table(str(path), file, place, names)
            if table is not None:
                tables.append(table)
    return tables


@contextmanager
def opened(path: Path) -> Iterator[Any]:
    """The file as asammdf reads it. Of one that its writer did not finalise, asammdf makes a copy, and leaves it behind
    where it fails: the copy is made in a folder that goes with it. Raises OSError, and what asammdf raises."""
    from asammdf import MDF

    with TemporaryDirectory() as copies:
        try:
            with MDF(path, temporary_folder=copies) as file:
                yield file
        except Exception as error:
            clear_frames(error.__traceback__)  # a half-made MDF would look for the folder later
            raise


def _table(source: str, file: Any, place: int, names: Counter[str]) -> RawTable | None:
    group = file.groups[place]
    master = file.masters_db.get(place)
    time = file.get_master(place)
    if master is None or not len(time):
        return None
    title = getattr(group.channel_group, "acq_name", "") or f"group {place + 1}"
    columns, odd = [], []
    for number, channel in enumerate(group.channels):
        if number == master:
            continue
        signal = file.get(group=place, index=number, ignore_invalidation_bits=True)
        values = signal.samples
        if values.dtype.kind not in "biuf" or values.ndim != 1 or len(values) != len(time):
            odd.append(channel.name)
            continue
        known = values.astype(np.float64)
        if signal.invalidation_bits is not None:
            known[np.asarray(signal.invalidation_bits, dtype=bool)] = np.nan
        heading = channel.name if names[channel.name] == 1 else f"{title}/{channel.name}"
        columns.append(Column(heading, heading, signal.unit or "", known))
    said = [f"{title}: no numbers, left out: {', '.join(odd)}"] if odd else []
    return table_of(source, seconds(time), columns, said, _metadata(group)) if columns else None


def _metadata(group: Any) -> dict[str, str]:
    """What upright wrote of a recording as the comment of its group."""
    try:
        found = json.loads(group.channel_group.comment)
    except (AttributeError, ValueError, TypeError):
        return {}
    return {key: value for key, value in found.items() if isinstance(value, str)} if isinstance(found, dict) else {}
