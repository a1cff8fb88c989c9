"""Where in a recording something may have set in: the instants at which a step would explain most.

The response of a predictor to a step does not depend on when the step comes but for its delay. So one pass, with the
step there from the beginning, serves for all instants: shifted by whole rows it is what a later step would do (the
generalised likelihood ratio: Willsky and Jones, IEEE Trans. Automatic Control 21, 1976), and its products with
innovations and nuisances at all shifts are correlations. The score test then looks at the best of them as at any other
shape.

What sets in takes as long as is usual, or is as sharp as the effect can be. A predictor that knows a random force at
the joint (models.random.disturbance) follows a step within a few rows: only these show it, and a slow step that is
tried at another instant than theirs explains next to nothing of a sudden one.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.signal import correlate

from diagnosis.prepare.candidates import Candidate
from diagnosis.score.whitened import Whitened
from estimators.data.time_scale import time_scale
from estimators.fit.problem import Problem
from models.effect import Role

Array = NDArray[np.float64]

SPACING = 0.25
"""Time scales (estimators.data.time_scale) between instants that are tried, 0.1 s of the MONOCAB: a step that takes
three times as long is told to less. What is sharper is tried as much more densely."""
APART = 2.5
"""Time scales between instants that are looked at."""
MOST = 2
"""Of these, of each rise."""
LEAST = 1e-9
"""Share of a step's information that has to be left beside the nuisances."""


def at_instants(candidate: Candidate, innovations: Whitened, full: Problem) -> Candidate:
    """`candidate` with further variants at the instants that explain most, if it sets in at an instant at all.

    `full` is the problem of the model with it. Only the first of its amplitudes is looked at, and only instants within
    the longest stretch. The variants of the usual rise come first, then those of the shortest.
    """
    instants = candidate.attached.of_role(Role.INSTANT)
    if not instants:
        return candidate
    name = instants[0]
    first, scale = float(full.segments[0].time[0]), time_scale(full.model, full.segments)
    longest = int(np.argmax([len(segment) for segment in full.segments]))
    time = full.segments[longest].time
    more: list[Mapping[str, float]] = []
    among = 0
    for shape, sharper in _rises(candidate):
        before = {**shape, name: min(0.0, first) - APART * scale}
        stretches = [moved[:, 0] for moved in innovations.moved(full, candidate.amplitudes[:1], before)]
        rows = max(1, round(SPACING * scale / sharper / float(np.median(np.diff(time)))))
        shifts = np.arange(rows, len(time), rows)
        gains = _gains(innovations, full, stretches, longest)[shifts]
        more += [{**shape, name: each} for each in _peaks(time[shifts].tolist(), gains.tolist(), APART * scale)]
        among += len(shifts)
    return replace(candidate, variants=(*candidate.variants, *more), picked=len(more), among=max(1, among))


def _rises(candidate: Candidate) -> list[tuple[Mapping[str, float], float]]:
    """The usual shape of `candidate`, and where it has a shortest rise the one with that; how many times sharper."""
    usual, durations = candidate.variants[0], candidate.attached.of_role(Role.DURATION)
    lower = {each.name: each.lower for each in candidate.attached.parameters if each.name in durations}
    shorter = [(name, least) for name, least in lower.items() if 0.0 < least < usual[name]]
    return [(usual, 1.0), *(({**usual, name: least}, usual[name] / least) for name, least in shorter)]


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
