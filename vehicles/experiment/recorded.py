"""The controller that held the vehicle up in a recording: from which sample on, and when and where it was excited.

Each kind of vehicle replays its controller on the recorded measurements (its `recorded_loop`). If it reproduces what
was sent, this controller was active, and its state at every sample is known. So the recording needs no metadata, and
one of another vehicle or of other software is detected.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from upright.telemetry.documents import from_json
from upright.telemetry.recording import Recording
from upright.vehicles.experiment.load import load_of
from upright.vehicles.experiment.phases import Phase

DRIVEN = ("drive_age", "excitation", "phase")
"""Channels without which the loop cannot be reconstructed."""
SAME = 0.01
"""Share of the RMS of what was sent by which the controller may differ from it: some samples may be lost."""


def designed_for(recording: Recording) -> dict[str, float]:
    """The parameters, SI, that the controller of `recording` was designed for; none if its metadata do not state them,
    as those of other software."""
    try:
        return {name: float(value) for name, value in from_json(recording.metadata.get("parameters", "{}")).items()}
    except (ValueError, TypeError, AttributeError):
        return {}


@dataclass(frozen=True, slots=True)
class Recorded:
    """A recording as lists, for loops. The controller held the vehicle from sample `held` on, excited from `first` to
    `last`; `period` s from sample to sample, and the control loop takes no cycle for longer than `longest` s. `stamped`
    are the times that the controller had."""

    values: Mapping[str, list[float]]
    time: list[float]
    stamped: list[float]
    period: float
    longest: float
    held: int
    first: int
    last: int

    def elapsed(self, row: int) -> float:
        """s since the sample before, limited as in the control loop: a gap does not upset its controller."""
        return min(max(self.stamped[row] - self.stamped[row - 1], 0.5 * self.period), self.longest)

    def row(self, time: float) -> int:
        """The sample at `time` s."""
        return int(np.searchsorted(self.time, time - 0.25 * self.period))


def recorded(
    recording: Recording, channels: Sequence[str], *, since: Phase, period: float, longest: float
) -> Recorded | str:
    """`recording` with `channels` and DRIVEN, and the samples between which its controller held the vehicle up, from
    the phase `since` on; or why they are not known, in words."""
    needed = (*channels, *DRIVEN)
    lacking = [name for name in needed if name not in recording.values]
    if lacking:
        return f"the recording has no channel {', '.join(lacking)}: the inputs of the controller are not known"
    phase, excitation = recording["phase"], recording["excitation"]
    if not np.isfinite(excitation).any() or not np.isfinite(phase).any():
        return "the recording does not contain the excitation (a raw CAN log never does): use the .arrow beside it"
    held = np.flatnonzero((phase >= since) & (phase <= Phase.FADE))
    excited = np.flatnonzero((phase >= Phase.EXCITE) & (phase <= Phase.FADE) & np.isfinite(excitation))
    if not len(excited) or not (np.any(excitation[excited]) or load_of(recording)):
        return "the vehicle is not excited while its controller holds it up"
    if held[0] == 0 or phase[held[0]] != since:
        return "the recording begins later than the controller, so that the controller's state is not known"
    if not all(np.isfinite(recording[name][held]).all() for name in needed):
        return "the recording has unknown values while the controller holds the vehicle up"
    return Recorded(
        values={name: recording[name].tolist() for name in needed},
        time=recording.time.tolist(),
        stamped=recording.stamped.tolist(),
        period=period,
        longest=longest,
        held=int(held[0]),
        first=int(excited[0]),
        last=int(excited[-1]),
    )


def entered_at(
    points: Sequence[str], given: Callable[[str], ArrayLike], record: Recorded, sent: Sequence[str]
) -> str | None:
    """The one of `points` at which the excitation entered; None if the controller reproduces the `sent` channels with
    none of them.

    `given(at)`, shape (channels, samples), is what the controller sends with the excitation entering at `at`, from the
    sample after `held` up to `last`. A cycle that comes late sends nothing, so that samples at which what was sent has
    not changed do not count, unless they are most.
    """
    columns = np.array([record.values[name][record.held : record.last] for name in sent])
    changed = (np.diff(columns) != 0.0).any(axis=0)
    counted = changed if np.mean(changed) > 0.5 else np.ones_like(changed)
    for at in points:
        errors = (np.asarray(given(at)) - columns[:, 1:])[:, counted]
        if np.sqrt(np.mean(errors**2)) < SAME * np.sqrt(np.mean(columns**2)):
            return at
    return None
