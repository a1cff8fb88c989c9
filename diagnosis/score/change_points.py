"""Change points of a recording: the times at which a step in an effect would explain most.

The response of a predictor to a step does not depend on the time of the step, except for the delay. So one pass, with
the step present from the beginning, serves for all change points: shifted by whole samples it is the response to a
later step (the generalised likelihood ratio: Willsky and Jones, IEEE Trans. Automatic Control 21, 1976), and its
products with innovations and nuisances at all shifts are correlations. The score test then treats the best of them like
any other shape.

A step rises in the usual time, or as sharply as the effect allows. A predictor that models a random force at the joint
(models.random.disturbance) follows a step within a few samples: only these show it, and a slow step that is tried at
any other time explains next to nothing of a sudden one.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from upright.diagnosis.prepare.candidates import Candidate
from upright.diagnosis.score.whitened import Whitened
from upright.estimators.data.time_scale import time_scale
from upright.estimators.fit.problem import Problem
from upright.models.effect import Role

Array = NDArray[np.float64]

SPACING = 0.25
"""Time scales (estimators.data.time_scale) between change points that are tried, 0.1 s of the MONOCAB: a step that
takes three times as long is located more accurately than that. Sharper steps are tried on a proportionally finer
grid."""
APART = 2.5
"""Time scales between the change points that are kept."""
MOST = 2
"""Number of change points that are kept for each rise time."""
LEAST = 1e-9
"""Share of a step's information that has to remain beside the nuisances."""


def at_instants(candidate: Candidate, innovations: Whitened, full: Problem) -> Candidate:
    """`candidate` with further variants at the change points that explain most, if it sets in at an instant at all.

    `full` is the problem of the model with the candidate. Only the first of its amplitudes is used, and only change
    points within the longest segment. The variants with the usual rise come first, then those with the shortest.
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
        responses = [moved[:, 0] for moved in innovations.moved(full, candidate.amplitudes[:1], before)]
        rows = max(1, round(SPACING * scale / sharper / float(np.median(np.diff(time)))))
        shifts = np.arange(rows, len(time), rows)
        gains = _gains(innovations, full, responses, longest)[shifts]
        more += [{**shape, name: each} for each in _peaks(time[shifts].tolist(), gains.tolist(), APART * scale)]
        among += len(shifts)
    return replace(candidate, variants=(*candidate.variants, *more), picked=len(more), among=max(1, among))


def _rises(candidate: Candidate) -> list[tuple[Mapping[str, float], float]]:
    """The usual shape of `candidate`, and the one with the shortest rise, if it has one; how many times sharper each
    is."""
    usual, durations = candidate.variants[0], candidate.attached.of_role(Role.DURATION)
    lower = {each.name: each.lower for each in candidate.attached.parameters if each.name in durations}
    shorter = [(name, least) for name, least in lower.items() if 0.0 < least < usual[name]]
    return [(usual, 1.0), *(({**usual, name: least}, usual[name] / least) for name, least in shorter)]


def _gains(innovations: Whitened, full: Problem, responses: Sequence[Array], which: int) -> Array:
    """How much a step from each sample of segment `which` on would explain, (rows,): the statistic of its score.

    `responses`: those to a step that is present from the beginning. A later segment has all of it, an earlier one none.
    """
    outputs = len(full.kernel.outputs)
    score = square = np.zeros(1)
    known = 0.0
    along = np.zeros((1, innovations.nuisance.shape[1]))
    place = 0
    for number, (moved, basis) in enumerate(zip(responses, innovations.starts, strict=True)):
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
    """The products of `response` (rows, ny), shifted to begin at each sample, with each of `others` (rows, ny, m),
    (rows, m): correlations, summed over the outputs as spectra."""
    from scipy.fft import irfft, next_fast_len, rfft  # imports that not every command needs

    rows = len(response)
    size = next_fast_len(2 * rows - 1, real=True)
    begun = np.conj(rfft(np.ascontiguousarray(response.T), size))
    found = []
    for each in range(others.shape[2]):
        spectra = rfft(np.ascontiguousarray(others[:, :, each].T), size)
        found.append(irfft(np.sum(begun * spectra, axis=0), size)[:rows])
    return np.stack(found, axis=1)


def _peaks(instants: Sequence[float], gains: Sequence[float], apart: float) -> list[float]:
    """The MOST change points that explain most, `apart` s or more from each other."""
    found: list[float] = []
    for place in np.argsort(gains)[::-1]:
        if all(abs(instants[place] - other) >= apart for other in found):
            found.append(instants[place])
        if len(found) == MOST:
            break
    return found
