"""What all steps of a diagnosis share: the recordings' usable rows, and problems of models on exactly these.

Rows are chosen with every candidate attached, so that each model is judged on the same rows whatever channels it needs.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, TypeVar

import numpy as np

from diagnosis.gates import Round
from diagnosis.prepare.actuator_samples import of_actuators
from diagnosis.prepare.candidates import Candidate, candidates_for
from diagnosis.trial import tried
from estimators.budget import UNLIMITED, Budget, OutOfTime
from estimators.data.resting import without_rests
from estimators.data.segments import segments
from estimators.data.time_scale import time_scale
from estimators.fit.problem import Problem, problem
from models.compiler.kernel import Progress
from models.effect import Effect
from models.model import Model
from models.segment import Segment
from telemetry.recording import Recording

Answer = TypeVar("Answer")

SETTLING = 0.5
"""Time scales (estimators.data.time_scale; 0.2 s of the MONOCAB) after which an actuator has forgotten what it was told
before the first row."""
EACH = 0.25
"""Share of the time that is left which one fit may take: one effect whose equations are stiff must not keep the others
from being tried."""


@dataclass(frozen=True, slots=True)
class Workspace:
    """`left_out`: effects that are no candidate, and why; `failed`: candidates that no fit of ended, and why. All that
    is fitted is within the `budget`; `untried` gathers in words what was left for want of time, `rounds` what was
    decided about each effect; `memory` has what was worked out of these samples once."""

    recordings: tuple[Recording, ...]
    support: float | None
    segments: tuple[Segment, ...]
    candidates: tuple[Candidate, ...]
    left_out: dict[str, str]
    failed: dict[str, str] = field(default_factory=dict)
    budget: Budget = UNLIMITED
    untried: list[str] = field(default_factory=list)
    rounds: list[Round] = field(default_factory=list)
    memory: dict[Hashable, Any] = field(default_factory=dict)

    @classmethod
    def of(
        cls,
        model: Model,
        recordings: Sequence[Recording],
        support: float | None,
        effects: Sequence[str | Effect] | None = None,
    ) -> Workspace:
        """Raises DataError where the recordings cannot be used."""
        found, left_out = candidates_for(model, recordings, effects)
        recordings = without_rests(model, recordings)
        rows = segments(attached(model, found), recordings, support=support)
        if of_actuators(model):
            settling = SETTLING * time_scale(model, rows)
            rows = [_settled(each, settling) for each in rows]
        return cls(tuple(recordings), support, tuple(rows), tuple(found), left_out)

    def problem(self, model: Model, progress: Progress | None = None) -> Problem:
        """The fit of `model` to all rows."""
        self.budget.check()
        return replace(problem(model, self.recordings, rows=self.segments, progress=progress), budget=self.budget)

    def within(self, share: float) -> Workspace:
        """The same for work that may take a share of the time that is left."""
        return replace(self, budget=self.budget.part(share))

    @property
    def for_one(self) -> Workspace:
        """The same for one fit of many."""
        return self.within(EACH)

    def in_time(self, work: Callable[[], Answer | None], what: str, failed: bool = False) -> Answer | None:
        """What `work` gives; None where it fails, or the time is over, and then `what` is left untried. Whether it has
        `failed` is noted, too, where it is the fit of a candidate."""
        try:
            return tried(work, what, self.failed if failed else None)
        except OutOfTime:
            self.leave(what)
            return None

    def leave(self, what: str) -> None:
        """Note what is left untried."""
        if what not in self.untried:
            self.untried.append(what)

    @property
    def unhurried(self) -> Workspace:
        """The same for what has to be done, however long it takes."""
        return replace(self, budget=UNLIMITED)

    @property
    def owners(self) -> tuple[int, ...]:
        """Of which of the recordings each segment is: within one of them time goes on."""
        places: list[int] = []
        place, before = 0, -math.inf
        for segment in self.segments:
            while self.recordings[place].source != segment.source or float(segment.time[0]) < before:
                place, before = place + 1, -math.inf
            places.append(place)
            before = float(segment.time[0])
        return tuple(places)

    def others(self, model: Model) -> list[Candidate]:
        """The candidates that `model` does not have yet."""
        there = {each.name for each in model.effects}
        return [each for each in self.candidates if each.name not in there]


def _settled(segment: Segment, settling: float) -> Segment:
    """Without what an actuator did in its first `settling` s: a command that acts later was given before them."""
    measured = segment.measured.copy()
    measured[1:][segment.time[1:] - segment.time[0] < settling] = np.nan
    return replace(segment, measured=measured)


def attached(model: Model, candidates: Sequence[Candidate]) -> Model:
    """`model` with all of `candidates`, each at its neutral value."""
    for candidate in candidates:
        model = model.add(candidate.effect, candidate.attached.at)
    return model
