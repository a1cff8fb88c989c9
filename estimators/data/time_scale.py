"""The time scale T of a model on a record, s: what windows, blocks, gates and horizons are multiples of.

It is the natural time of the model (models.natural_time), which its author's typical sizes say, bounded by the record:

* from above by FAR motion times: where the joints of the record swing a hundred times as fast as those sizes have it,
  these are wrong, and the record is right;
* from below by LEAST rows, since fewer say nothing of what is between them.

So the same plant at another pace, sampled at that pace, has T in proportion, and all that follows from T holds the same
rows. The motion time is 1 / (2 pi f), f the mean frequency of a coordinate's power, of the joint that moves slowest:
of a multisine on the MONOCAB 0.17 s, of its square wave 0.43 s, where T is 0.4 s.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from models.expressions import names_in
from models.model import Model
from models.natural_time import natural_time, rounded
from models.segment import Segment

Array = NDArray[np.float64]

FAR = 5.0
"""Motion times that T may be at most. Of one frequency, as far below it as a controlled vehicle is ever moved."""
LEAST = 10
"""Rows that T is at least."""
MANY = 100
"""Rows that T is where a model says nothing of its times."""
AHEAD = 1.25
"""Time scales ahead at which predictions are told where nothing else is asked: half a second of the MONOCAB, far enough
for a missing force to show."""
LONG = 20.0
"""Times T that a stretch has to be for its motion to bound it: of a shorter one the slow part is not seen."""


def time_scale(model: Model, rows: Sequence[Segment]) -> float:
    """T of `model` on `rows`, s."""
    spacing = float(np.median(np.diff(rows[0].time)))
    natural = natural_time(model)
    if natural is None:
        return MANY * spacing
    moves = motion_time(model, rows)
    longest = max(segment.duration for segment in rows)
    if moves is not None and LONG * FAR * moves < longest:
        natural = min(natural, FAR * moves)
    return rounded(max(natural, LEAST * spacing))


def horizon(model: Model, rows: Sequence[Segment]) -> float:
    """How far ahead predictions of `model` are told on `rows`, s."""
    return rounded(AHEAD * time_scale(model, rows))


def motion_time(model: Model, rows: Sequence[Segment]) -> float | None:
    """1 / (2 pi f) of the joint that moves slowest in `rows`, s; None where none of them is measured or moves."""
    found = []
    for joint in model.joints:
        angles, rates = (_shown(model, text) for text in (joint.coordinate, joint.rate))
        found += [_mean_frequency(rows, place, integrals=0 if angles else 1) for place in angles or rates]
    slowest = min((each for each in found if each > 0.0), default=0.0)
    return 1.0 / (2.0 * np.pi * slowest) if slowest > 0.0 else None


def _shown(model: Model, text: str) -> list[int]:
    """Places of the outputs that show what `text` names, by their own names or by what they are of."""
    names = names_in(text)
    return [
        place
        for place, each in enumerate(model.outputs)
        if each.name in names or (each.expression != each.name and names & names_in(each.expression))
    ]


def _mean_frequency(rows: Sequence[Segment], place: int, integrals: int) -> float:
    """Hz, of the power of an output or, with `integrals` of 1, of what it is the rate of; 0 where it does not move."""
    moment = total = 0.0
    for segment in rows:
        known = np.isfinite(segment.measured[:, place])
        if len(segment) < 4 or not known.any():
            continue
        values = np.interp(segment.time, segment.time[known], segment.measured[known, place])
        spectrum = np.fft.rfft((values - np.mean(values)) * np.hanning(len(values)))[1:]
        frequency = np.arange(1, len(spectrum) + 1) / (len(values) * float(np.median(np.diff(segment.time))))
        power = np.abs(spectrum) ** 2 / frequency ** (2 * integrals)
        moment, total = moment + float(np.sum(power * frequency)), total + float(np.sum(power))
    return moment / total if total > 0.0 else 0.0
