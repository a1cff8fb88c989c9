"""What a search goes from one of to the next, and what all its steps share."""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import dataclass, replace
from functools import partial

from diagnosis.findings import Finding
from diagnosis.fits.refit import FullFit
from diagnosis.prepare.workspace import Workspace
from diagnosis.score.score_test import ScoreTest

NOTHING_SCORED = ScoreTest((), {})
Tell = Callable[[str, float], None]
"""Is told in words what is being done, and the share of it that is over, 0 to 1."""


def silent(text: str, share: float) -> None:
    """Tells nobody."""


@dataclass(frozen=True, slots=True)
class Explanation:
    """Effects that together explain what a model leaves: a finding of each, and the `fit` of the model with them."""

    findings: tuple[Finding, ...]
    fit: FullFit

    @property
    def names(self) -> tuple[str, ...]:
        """Of its effects, in the order in which they explain most."""
        return tuple(each.effect for each in self.findings)

    @property
    def gain(self) -> float:
        """Of log likelihood, by all its effects, nats."""
        return sum(each.log_likelihood_gain for each in self.findings)


@dataclass(frozen=True, slots=True)
class Search:
    """What the steps of one search share. `confounded`: effects that the score test does not see, because parameters
    of the model imitate them (diagnosis.fits.confounded); `most`: effects that are added at most; `alone`: the score
    test of the model without any of them."""

    workspace: Workspace
    confounded: Collection[str] = ()
    most: int = 3
    alone: ScoreTest = NOTHING_SCORED
    tell: Tell = silent

    @property
    def quiet(self) -> Search:
        """The same, of which nobody is told."""
        return replace(self, tell=silent)

    def part(self, begin: float, width: float) -> Search:
        """The same for a step that begins at a share of the whole, and is `width` of it."""
        return replace(self, tell=partial(part_of, self.tell, begin, width))


def part_of(tell: Tell, begin: float, width: float, text: str, share: float) -> None:
    """`share` of one step, which began at `begin` and is `width` of the whole."""
    tell(text, begin + width * share)
