"""Where in a recording something may have set in: the instants at which a step would explain most.

The response of a predictor to a step does not depend on when the step comes but for its delay. So one pass, with the
step there from the beginning, serves for all instants: shifted by whole rows it is what a later step would do (the
generalised likelihood ratio: Willsky and Jones, IEEE Trans. Automatic Control 21, 1976), and its products with
innovations and nuisances at all shifts are correlations. The screen then looks at the best of them as at any other
shape.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.signal import correlate

from diagnosis.candidates import Candidate
from diagnosis.whitened import Whitened
from estimators.problem import Problem
from estimators.time_scale import time_scale

Array = NDArray[np.float64]

INSTANT = "start"
"""What an effect calls the instant, s from the first row of a recording on, at which it sets in."""
SPACING = 0.25
"""Time scales (estimators.time_scale) between instants that are tried, 0.1 s of the MONOCAB: a step that takes three
times as long is told to less."""
APART = 2.5
"""Time scales between instants that are looked at."""
MOST = 2
LEAST = 1e-9
"""Share of a step's information that has to be left beside the nuisances."""


def at_instants(candidate: Candidate, innovations: Whitened, full: Problem) -> Candidate:
    """`candidate` with further variants at the instants that explain most, if it sets in at an instant at all.

    `full` is the problem of the model with it. Only the first of its amplitudes is looked at, and only instants within
    the longest stretch.
    """
    name = candidate.attached.qualified(INSTANT)
    if name not in candidate.shapes:
        return candidate
    first, scale = float(full.segments[0].time[0]), time_scale(full.model, full.segments)
    before = {**candidate.variants[0], name: min(0.0, first) - APART * scale}
    stretches = [moved[:, 0] for moved in innovations.moved(full, candidate.amplitudes[:1], before)]
    longest = int(np.argmax([len(segment) for segment in full.segments]))
    time = full.segments[longest].time
    rows = max(1, round(SPACING * scale / float(np.median(np.diff(time)))))
    shifts = np.arange(rows, len(time), rows)
    gains = _gains(innovations, full, stretches, longest)[shifts]
    more = [
        {**candidate.variants[0], name: each} for each in _peaks(time[shifts].tolist(), gains.tolist(), APART * scale)
    ]
    return replace(candidate, variants=(*candidate.variants, *more), picked=len(more), among=max(1, len(shifts)))


def _gains(innovations: Whitened, full: Problem, stretches: Sequence[Array], which: int) -> Array:
    """How much a step from each row of stretch `which` on would explain, (rows,): the statistic of its score.

    `stretches`: what a step there from the beginning on does. A later stretch has it whole, an earlier one not at all.
    """
    outputs = len(full.kernel.outputs)
    score = square = np.zeros(1)
    known = 0.0
    along = np.zeros((1, innovations.nuisance.shape[1]))
    place = 0
    for number, (moved, basis) in enumerate(zip(stretches, innovations.starts, strict=True)):
        part = slice(place, place + len(moved))
        place += len(moved)
        if number < which:
            continue
        end = len(full.segments[number]) * outputs
        others = np.column_stack((innovations.residual[part], innovations.nuisance[part], basis))[:end]
        if number == which:
            products = _shifted(moved[:end].reshape(-1, outputs), others.reshape(-1, outputs, others.shape[1]))
            squares = np.cumsum(np.sum(moved[:end].reshape(-1, outputs) ** 2, axis=1))[::-1]
        else:
            products, squares = (moved[:end] @ others)[None], np.array([moved[:end] @ moved[:end]])
        nuisances = 1 + innovations.nuisance.shape[1]
        score = score + products[:, 0]
        along = along + products[:, 1:nuisances]
        square = square + squares - np.sum(products[:, nuisances:] ** 2, axis=1)
        known += float(np.max(squares))
    left = square - np.sum(along**2, axis=1)
    return np.where(left > LEAST * known, score**2 / np.maximum(left, LEAST * known), 0.0)


def _shifted(response: Array, others: Array) -> Array:
    """The products of `response` (rows, ny), begun at each row, with each of `others` (rows, ny, m), (rows, m)."""
    rows = len(response)
    found = [
        sum(correlate(others[:, output, each], response[:, output])[rows - 1 :] for output in range(response.shape[1]))
        for each in range(others.shape[2])
    ]
    return np.stack(found, axis=1)


def _peaks(instants: Sequence[float], gains: Sequence[float], apart: float) -> list[float]:
    """The MOST instants that explain most, `apart` s or more from each other."""
    found: list[float] = []
    for place in np.argsort(gains)[::-1]:
        if all(abs(instants[place] - other) >= apart for other in found):
            found.append(instants[place])
        if len(found) == MOST:
            break
    return found
