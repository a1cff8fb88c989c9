"""Where in a recording something may have set in: the instants at which a step would explain most.

The response of a predictor to a step does not depend on when the step comes but for its delay. So one pass, with the
step there from the beginning, serves for all instants: shifted by whole rows it is what a later step would do (the
generalised likelihood ratio: Willsky and Jones, IEEE Trans. Automatic Control 21, 1976). The screen then looks at the
best of them as at any other shape.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from diagnosis.candidates import Candidate
from diagnosis.whitened import Whitened, less, project
from estimators.problem import Problem

Array = NDArray[np.float64]

INSTANT = "start"
"""What an effect calls the instant, s from the first row of a recording on, at which it sets in."""
SPACING = 0.1
"""s between instants that are tried: a step of 0.3 s is told to less."""
APART = 1.0
"""s between instants that are looked at."""
MOST = 2
AT_ONCE = 64
"""Instants in one product of matrices."""


def at_instants(candidate: Candidate, innovations: Whitened, full: Problem) -> Candidate:
    """`candidate` with further variants at the instants that explain most, if it sets in at an instant at all.

    `full` is the problem of the model with it. Only the first of its amplitudes is looked at.
    """
    name = candidate.attached.qualified(INSTANT)
    if name not in candidate.shapes:
        return candidate
    first = float(full.segments[0].time[0])
    before = {**candidate.variants[0], name: min(0.0, first) - APART}
    stretches = innovations.moved(full, candidate.amplitudes[:1], before)
    gains: list[float] = []
    instants: list[float] = []
    longest = int(np.argmax([len(segment) for segment in full.segments]))
    segment = full.segments[longest]
    rows = max(1, round(SPACING / float(np.median(np.diff(segment.time)))))
    shifts = np.arange(rows, len(segment), rows)
    for some in np.array_split(shifts, len(shifts) // AT_ONCE + 1):
        columns = project(_steps(innovations, full, stretches, longest, some), innovations.nuisance)
        information = np.maximum(np.sum(columns**2, axis=0), 1e-300)
        gains += ((columns.T @ innovations.residual) ** 2 / information).tolist()
        instants += segment.time[some].tolist()
    more = [{**candidate.variants[0], name: each} for each in _peaks(instants, gains)]
    return replace(candidate, variants=(*candidate.variants, *more), picked=len(more), among=max(1, len(instants)))


def _steps(
    innovations: Whitened, full: Problem, stretches: Sequence[Array], which: int, begins: NDArray[np.int64]
) -> Array:
    """What a step from each of the rows `begins` (m,) of stretch `which` on would do, (n, m)."""
    outputs = len(full.kernel.outputs)
    parts = []
    for number, (moved, basis) in enumerate(zip(stretches, innovations.starts, strict=True)):
        columns = np.zeros((len(moved), len(begins)))
        end = len(full.segments[number]) * outputs
        for place, begin in enumerate(begins):
            shift = 0 if number > which else begin * outputs if number == which else end
            columns[shift:end, place] = moved[: end - shift, 0]
        parts.append(less(columns, basis))
    return np.concatenate(parts)


def _peaks(instants: Sequence[float], gains: Sequence[float]) -> list[float]:
    """The MOST instants that explain most, APART or more from each other."""
    found: list[float] = []
    for place in np.argsort(gains)[::-1]:
        if all(abs(instants[place] - other) >= APART for other in found):
            found.append(instants[place])
        if len(found) == MOST:
            break
    return found
