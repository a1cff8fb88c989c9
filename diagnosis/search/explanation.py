"""The state that a search passes from one step to the next, and what all its steps share."""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import dataclass, replace
from functools import partial

from upright.diagnosis.findings import Finding
from upright.diagnosis.fits.refit import FullFit
from upright.diagnosis.prepare.workspace import Workspace
from upright.diagnosis.score.score_test import ScoreTest

NOTHING_SCORED = ScoreTest((), {})
Progress = Callable[[str, float], None]
"""Is called with a text for the current step, and the share of it that is done, 0 to 1."""


def no_progress(text: str, share: float) -> None:
    """Reports nothing."""


@dataclass(frozen=True, slots=True)
class Explanation:
    """Effects that together explain the lack of fit of a model: a finding for each, and the `fit` of the model with
    them."""

    findings: tuple[Finding, ...]
    fit: FullFit

    @property
    def names(self) -> tuple[str, ...]:
        """Names of its effects, in the order in which they explain most."""
        return tuple(each.effect for each in self.findings)

    @property
    def gain(self) -> float:
        """Rise of the log-likelihood by all its effects, nats."""
        return sum(each.log_likelihood_gain for each in self.findings)


@dataclass(frozen=True, slots=True)
class Search:
    """What the steps of one search share. `confounded`: effects that the score test does not see, because parameters of
    the model imitate them (diagnosis.fits.confounded); `most`: maximum number of effects that are added; `alone`: the
    score test of the model without any of them. `found`: effects whose formulas may leave what a further one explains;
    `of_impacts`: what those effects of the original model whose parts collide may leave, nats."""

    workspace: Workspace
    confounded: Collection[str] = ()
    most: int = 3
    alone: ScoreTest = NOTHING_SCORED
    found: tuple[Finding, ...] = ()
    of_impacts: float = 0.0
    progress: Progress = no_progress

    @property
    def quiet(self) -> Search:
        """The same without progress reports."""
        return replace(self, progress=no_progress)

    def part(self, begin: float, width: float) -> Search:
        """The same for a step that begins at a share of the whole, and is `width` of it."""
        return replace(self, progress=partial(part_of, self.progress, begin, width))


def part_of(progress: Progress, begin: float, width: float, text: str, share: float) -> None:
    """Reports `share` of one step, which began at `begin` and is `width` of the whole."""
    progress(text, begin + width * share)
