"""How well a model predicts a table, read in some way: its log-likelihood ratio to an extrapolation of each channel.

    score = ln L(model) - sum over the measured channels of ln L(extrapolation)

Both predict each sample from all before, the extrapolation by a linear regression on the last ORDER samples of the
channel itself (an autoregression), so the unit of a channel cancels. The model is fitted with its CAD values as prior.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from upright.estimators.contract import EstimationError
from upright.estimators.data.segments import segments
from upright.estimators.fit.maximum_likelihood import fit
from upright.estimators.fit.problem import problem
from upright.models.model import Model
from upright.models.segment import Segment
from upright.telemetry.errors import RecordingError
from upright.telemetry.recording import Recording

Array = NDArray[np.float64]

ORDER = 12
"""Samples that are extrapolated from."""
STEPS = 15
"""Of a fit; it has to tell units apart, not to be exact."""


@dataclass(frozen=True, slots=True)
class Score:
    """`log_ratio`: log-likelihood ratio, of one sample; `rows` samples; `off`: how far the parameters are from their
    CAD values, as a part of the cost (half the sum of squared deviations)."""

    log_ratio: float
    rows: int
    off: float


def score(model: Model, recording: Recording | None, support: float | None) -> Score | None:
    """The score of a reading of `recording`; None if the model cannot be fitted to it at all."""
    if recording is None:
        return None
    try:
        with np.errstate(all="ignore"):
            rows = segments(model, [recording], support=support)
            task = problem(model, [], rows=rows)
            found = fit(task, iterations=STEPS)
            plain = extrapolated(rows)
    except (EstimationError, RecordingError, ArithmeticError, np.linalg.LinAlgError, ValueError):
        return None
    off = sum(
        ((value - each.value) / each.std) ** 2
        for value, each in zip(found.minimum.common, task.parameters, strict=False)
        if each.std
    )
    ratio = (plain - found.minimum.cost) / task.rows
    return Score(float(ratio), task.rows, 0.5 * float(off)) if np.isfinite(ratio) else None


def extrapolated(rows: list[Segment]) -> float:
    """The cost of extrapolation, as of a fit: n ln(RMS error), summed over the channels."""
    cost = 0.0
    for place in range(rows[0].measured.shape[1]):
        parts = [segment.measured[:, place] for segment in rows]
        parts = [part for part in parts if len(part) > 2 * ORDER and np.isfinite(part).all()]
        if not parts:
            continue
        count = sum(len(segment) for segment in rows)
        before = np.concatenate([np.lib.stride_tricks.sliding_window_view(part[:-1], ORDER) for part in parts])
        after = np.concatenate([part[ORDER:] for part in parts])
        known = np.column_stack((before, np.ones(len(before))))
        factors, *_ = np.linalg.lstsq(known, after, rcond=None)
        error = after - known @ factors
        cost += 0.5 * count * float(np.log(max(np.mean(error**2), np.finfo(float).tiny)))
    return cost
