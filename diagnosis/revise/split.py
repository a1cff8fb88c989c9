"""The data that a model is fitted to, and those that are held out: other recordings, or the last third of each."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from upright.diagnosis.prepare.pieces import only
from upright.estimators.data.segments import segments
from upright.models.model import Model
from upright.telemetry.recording import Recording

TRAINING = 2.0 / 3.0
"""Share of a recording's usable samples, in time, that is fitted if no recording is held out."""


def split(
    model: Model, recordings: Sequence[Recording], held_out: Sequence[Recording], support: float | None = None
) -> tuple[list[Recording], list[Recording]]:
    """The data to fit and to hold out, both non-empty. Raises DataError if `recordings` cannot be used at all."""
    if held_out:
        return list(recordings), list(held_out)
    training, tried = [], []
    for recording in recordings:
        rows = np.concatenate([segment.time for segment in segments(model, [recording], support=support)])
        early = recording.time <= np.quantile(rows, TRAINING)
        training.append(only(model, recording, early))
        tried.append(only(model, recording, ~early))
    return training, tried
