"""Exclusion of samples at which encoders only show that the axis is at rest, to within one count.

Static friction holds a machine against any force up to a limit, but a formula that is regularised as a slope at rest
does not hold it for long. If each of many samples with the same count were a measurement, this formula error would
outweigh all motion before. So if every output is counted and none has changed for longer than REST, the samples up to
the next count are left out, and the data on either side become separate segments.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from upright.models.model import Model
from upright.models.natural_time import USUAL, natural_time
from upright.telemetry.recording import Recording

REST = 1.0
"""Natural times (models.natural_time) of the same count that mean rest: an oscillating axis has reversed by then."""


def without_rests(model: Model, recordings: Sequence[Recording]) -> list[Recording]:
    """`recordings` with the outputs of `model` unknown while they only show that nothing moves."""
    names = [each.name for each in model.outputs]
    if not names or not all(each.counted for each in model.outputs):
        return list(recordings)
    return [_without(each, names, REST * (natural_time(model) or USUAL)) for each in recordings]


def _without(recording: Recording, names: Sequence[str], kept: float) -> Recording:
    if any(name not in recording.values for name in names):
        return recording
    rests = _rests(np.stack([recording[name] for name in names], axis=1), recording.time, kept)
    if not rests.any():
        return recording
    hidden = {name: np.where(rests, np.nan, recording[name]) for name in names}
    return replace(recording, values={**recording.values, **hidden})


def _rests(counts: NDArray[np.float64], time: NDArray[np.float64], longest: float) -> NDArray[np.bool_]:
    """Mask (n,) of the samples within a run of identical `counts` (n, m) longer than `longest` s, without its first
    sample."""
    changes = np.flatnonzero(np.any(np.diff(counts, axis=0) != 0.0, axis=1)) + 1
    starts = np.concatenate(([0], changes))
    ends = np.concatenate((time[changes], time[-1:]))
    place = np.searchsorted(changes, np.arange(len(time)), side="right")
    rests = (ends - time[starts] > longest)[place]
    rests[starts] = False
    return np.asarray(rests)
