"""What all steps of a diagnosis share: the usable samples of the recordings, and problems of models on exactly these.

Samples are chosen with every candidate attached, so that each model is judged on the same ones whatever channels it
needs.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, TypeVar

import numpy as np

from upright.diagnosis.gates import Round
from upright.diagnosis.prepare.actuator_samples import of_actuators
from upright.diagnosis.prepare.candidates import Candidate, candidates_for
from upright.diagnosis.trial import tried
from upright.estimators.budget import UNLIMITED, Budget, OutOfTime
from upright.estimators.data.resting import without_rests
from upright.estimators.data.segments import segments
from upright.estimators.data.time_scale import time_scale
from upright.estimators.fit.problem import Problem, problem
from upright.models.compiler.kernel import Progress
from upright.models.effect import Effect
from upright.models.model import Model
from upright.models.segment import Segment
from upright.telemetry.recording import Recording

Answer = TypeVar("Answer")

SETTLING = 0.5
"""Time scales (estimators.data.time_scale; 0.2 s of the MONOCAB) after which commands from before the first sample no
longer affect an actuator."""
EACH = 0.25
"""Share of the remaining time that one fit may take: one effect with stiff equations must not keep the others from
being tried."""


@dataclass(frozen=True, slots=True)
class Workspace:
    """`left_out`: effects that are not candidates, and why; `failed`: candidates whose fits all failed, and why. All
    fits are within the `budget`; `untried` collects in words what was left for lack of time, `rounds` what was decided
    about each effect; `memory` keeps results for these samples."""

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
        """Raises DataError if the recordings cannot be used."""
        found, left_out = candidates_for(model, recordings, effects)
        recordings = without_rests(model, recordings)
        rows = segments(attached(model, found), recordings, support=support)
        if of_actuators(model):
            settling = SETTLING * time_scale(model, rows)
            rows = [_settled(each, settling) for each in rows]
        return cls(tuple(recordings), support, tuple(rows), tuple(found), left_out)

    def problem(self, model: Model, progress: Progress | None = None) -> Problem:
        """The fit of `model` to all samples."""
        self.budget.check()
        return replace(problem(model, self.recordings, rows=self.segments, progress=progress), budget=self.budget)

    def within(self, share: float) -> Workspace:
        """The same for work that may take a share of the remaining time."""
        return replace(self, budget=self.budget.part(share))

    @property
    def for_one(self) -> Workspace:
        """The same for one fit of many."""
        return self.within(EACH)

    def in_time(self, work: Callable[[], Answer | None], what: str = "", failed: bool = False) -> Answer | None:
        """The result of `work`; None if it fails, or if time runs out, and then `what` is left untried, unless it is
        empty. If it is the fit of a candidate (`failed`), its failure is recorded, too."""
        try:
            return tried(work, what, self.failed if failed else None)
        except OutOfTime:
            if what:
                self.leave(what)
            return None

    def leave(self, what: str) -> None:
        """Record that `what` is left untried."""
        if what not in self.untried:
            self.untried.append(what)

    @property
    def unlimited(self) -> Workspace:
        """The same for work that has to be done, however long it takes."""
        return replace(self, budget=UNLIMITED)

    @property
    def owners(self) -> tuple[int, ...]:
        """The index of the recording of each segment: time continues within a recording."""
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
    """Without the outputs of an actuator in its first `settling` s: commands that act then may have been given
    before."""
    measured = segment.measured.copy()
    measured[1:][segment.time[1:] - segment.time[0] < settling] = np.nan
    return replace(segment, measured=measured)


def attached(model: Model, candidates: Sequence[Candidate]) -> Model:
    """`model` with all of `candidates`, each at its neutral value."""
    for candidate in candidates:
        model = model.add(candidate.effect, candidate.attached.at)
    return model
