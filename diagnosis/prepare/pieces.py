"""Pieces of a recording's time, and a recording with the measurements in some of them hidden."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from upright.models.model import Model
from upright.telemetry.recording import Recording

Pieces = tuple[tuple[float, float], ...]
"""s of a recording, from and to."""


def inside(time: NDArray[np.float64], pieces: Pieces) -> NDArray[np.bool_]:
    """Which of the samples at `time` (n,) are in `pieces`."""
    return np.asarray(np.any([(time >= begin) & (time < end) for begin, end in pieces], axis=0))


def hidden(model: Model, recording: Recording, pieces: Pieces) -> Recording:
    """`recording` with the outputs of `model` unknown in `pieces`."""
    return only(model, recording, ~inside(recording.time, pieces))


def only(model: Model, recording: Recording, kept: NDArray[np.bool_]) -> Recording:
    """`recording` with the outputs of `model` known only at the samples `kept` (n,): its time still starts at its first
    sample, as effects that depend on it require."""
    values = {each.name: np.where(kept, recording[each.name], np.nan) for each in model.outputs}
    return replace(recording, values={**recording.values, **values})
