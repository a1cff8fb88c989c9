"""What a model is fitted to, and what it is then tried on: recordings of their own, or the last third of each."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from estimators.data.segments import segments
from models.model import Model
from telemetry.recording import Recording

TRAINING = 2.0 / 3.0
"""Share of a recording's usable rows, in time, that is fitted where no recording is held out."""


def split(
    model: Model, recordings: Sequence[Recording], held_out: Sequence[Recording], support: float | None = None
) -> tuple[list[Recording], list[Recording]]:
    """What to fit and what to try, both non-empty. Raises DataError where `recordings` cannot be used at all."""
    if held_out:
        return list(recordings), list(held_out)
    training, tried = [], []
    for recording in recordings:
        rows = np.concatenate([segment.time for segment in segments(model, [recording], support=support)])
        early = recording.time <= np.quantile(rows, TRAINING)
        training.append(_only(model, recording, early))
        tried.append(_only(model, recording, ~early))
    return training, tried


def _only(model: Model, recording: Recording, kept: NDArray[np.bool_]) -> Recording:
    """`recording` with the measured outputs known where `kept` (n,) alone: time goes on counting from its first row,
    as effects that depend on it ask for."""
    hidden = {each.name: np.where(kept, recording[each.name], np.nan) for each in model.outputs}
    return replace(recording, values={**recording.values, **hidden})
