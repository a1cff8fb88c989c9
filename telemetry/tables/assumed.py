"""A recording in which a channel is taken for something else: in another unit, turned, wrapped, or swapped."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from upright.telemetry.errors import RecordingError
from upright.telemetry.options import assumed
from upright.telemetry.recording import FARTHEST, Recording
from upright.telemetry.tables.mapping import Assumption, factor_of
from upright.telemetry.tables.matched import unwrapped


def as_assumed(recording: Recording, channel: str, how: Assumption) -> Recording:
    """`recording`, whose values are SI units so far, with `channel` (`time` for the time stamps) as assumed."""
    given = factor_of(how.unit) if how.unit else None
    factor = given.factor if given else 1.0
    if channel == "time":
        since = (recording.timestamp_ns - recording.timestamp_ns[0]).astype(np.float64) * factor
        if not np.max(np.abs(since)) < FARTHEST:
            what = f"would last {1e-9 * float(np.max(since)):.3g} s in {how.unit}"
            raise RecordingError(
                recording.source, "time", what, remedy=f"State another unit: {assumed({'time': 'ms'})}."
            )
        return replace(recording, timestamp_ns=np.round(since).astype(np.int64), stamped_ns=None)
    values = dict(recording.values)
    if how.swapped:
        values[channel], values[how.swapped] = values[how.swapped], values[channel]
    if how.wrapped is not None:
        values[channel] = unwrapped(values[channel], how.wrapped or 2.0 * np.pi / abs(factor))
    values[channel] = values[channel] * factor
    return replace(recording, values=values)
