"""The time scale T of a model on a record, s. Windows, blocks, gates and horizons are multiples of it.

It is the natural time of the model (models.natural_time), from the typical magnitudes that its author states, bounded
by the record:

* from above by FAR motion times: if the joints move a hundred times as fast in the record as those magnitudes imply,
  the record is right;
* from below by LEAST sampling periods, since fewer samples do not resolve the motion.

So if the same plant is faster by a factor, and sampled faster by that factor, T scales with it, and everything derived
from T covers the same samples. The motion time is 1 / (2 pi f), where f is the mean frequency of the power spectrum of
a coordinate, for the slowest joint: 0.17 s for a multisine on the MONOCAB and 0.43 s for its square wave, with T of
0.4 s.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from upright.models.model import Model
from upright.models.natural_time import natural_time, rounded
from upright.models.segment import Segment
from upright.models.text.expressions import names_in

Array = NDArray[np.float64]

FAR = 5.0
"""T is at most this many motion times. With a single frequency, it is as far below it as a controlled vehicle is ever
moved."""
LEAST = 10
"""T is at least this many sampling periods."""
MANY = 100
"""T in sampling periods if a model states nothing about its times."""
AHEAD = 1.25
"""Default prediction horizon in time scales: half a second for the MONOCAB, long enough for a missing force to show."""
LONG = 20.0
"""A segment must be longer than this many times the bound of T for its motion to bound T: a shorter one does not show
the slow motion."""


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
    """Prediction horizon of `model` on `rows`, s."""
    return rounded(AHEAD * time_scale(model, rows))


def motion_time(model: Model, rows: Sequence[Segment]) -> float | None:
    """1 / (2 pi f) of the slowest joint in `rows`, s; None if none of them is measured or moves."""
    found = []
    for joint in model.joints:
        angles, rates = (_shown(model, text) for text in (joint.coordinate, joint.rate))
        found += [_mean_frequency(rows, place, integrals=0 if angles else 1) for place in angles or rates]
    slowest = min((each for each in found if each > 0.0), default=0.0)
    return 1.0 / (2.0 * np.pi * slowest) if slowest > 0.0 else None


def _shown(model: Model, text: str) -> list[int]:
    """Indices of the outputs that measure what `text` names, by their name or by their expression."""
    names = names_in(text)
    return [
        place
        for place, each in enumerate(model.outputs)
        if each.name in names or (each.expression != each.name and names & names_in(each.expression))
    ]


def _mean_frequency(rows: Sequence[Segment], place: int, integrals: int) -> float:
    """Mean frequency (Hz) of the power of an output or, if `integrals` is 1, of its integral; 0 if it does not move."""
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
