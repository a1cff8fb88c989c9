"""The lines of a results file grouped by the RMS of their disturbance, in thirds."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from upright.service.hidden_effects.disturbances import NONE
from upright.service.hidden_effects.trial import Line

FEW = 3
"""Maximum number of different RMS values for which each one is a group of its own."""


def thirds(lines: Sequence[Line]) -> dict[str, list[Line]]:
    """The lines by disturbance, the weakest first: those without one, then an equal number of lines in each third.

    Empty if no line has a disturbance, as in the files of older versions.
    """
    disturbed = sorted((line for line in lines if line.get("disturbance")), key=_rms)
    if not disturbed:
        return {}
    still = [line for line in lines if not line.get("disturbance")]
    parts = {NONE: still} if still else {}
    values = sorted({_rms(line) for line in disturbed})
    if len(values) <= FEW:
        return parts | {f"{value:.3g} N m": [line for line in disturbed if _rms(line) == value] for value in values}
    bounds = [0, *(int(bound) for bound in np.round(np.array([1.0, 2.0]) / 3.0 * len(disturbed))), len(disturbed)]
    for begin, end in pairwise(bounds):
        third = disturbed[begin:end]
        parts[f"{_rms(third[0]):.3g} to {_rms(third[-1]):.3g} N m"] = third
    return parts


def _rms(line: Line) -> float:
    return float(line["disturbance"]["rms"])
