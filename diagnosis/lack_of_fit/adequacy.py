"""Is anything left in the innovations of a model that chance does not explain, whatever its name?

The measure is the floor: what a right model would leave, by the noise that the record itself shows. The four views of
where_it_fails test it at one per cent in all. No formula is exact, though, and a long record shows that real friction
is not quite its formula: what a named effect leaves of the energy over the floor is a failure above a share of it.

The wrong neighbour closes most of the gap, too, so a small rest proves no name. Forces of any shape
(diagnosis.lack_of_fit.shapes) are let in beside the named effects: where one of them gains a good part of what these
gained, the names are wrong.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from diagnosis.lack_of_fit.floor import Innovations, floor, innovations, shaken_as
from diagnosis.lack_of_fit.force_probe import probe
from diagnosis.lack_of_fit.shapes import Shape, shapes
from diagnosis.lack_of_fit.where_it_fails import Views, summary, views
from diagnosis.trial import FAILURES
from estimators.fit.maximum_likelihood import Fit

Array = NDArray[np.float64]

LEFT = 0.05
"""Share of the energy over the floor, before anything was added, that an effect by its right name may leave."""
LEFT_BY_IMPACTS = 0.3
"""The same where parts strike each other: a blow that comes a row early or late is an error of dozens of deviations.
Play of a gear by its right name left 12 to 23 % on six records, another name 90 % and more."""
SHAPED = 0.12
"""Share of what the named effects gained in log likelihood that a shape without a name may gain beside them.

Dry friction with bristles leaves 2 to 11 % of what tanh gained, a wrong name 17 % and more."""
EXPLAINED = 0.5
"""Share of what is left that a shape without a name may explain: the friction of an axis, by its right name, leaves a
rest of which a curve over the rate explains a fifth; that of cubic drag, called quadratic, nine tenths.

Where a record shows much of an effect, what its formula lacks is far above the noise, and the noise of the fit stands
in for it: the gain says little then."""
SIGNIFICANT = 2.0
"""Standard deviations by which that gain has to be more: of a short record 30 % of 50 nats may as well be 4 %."""
CHANCE = 1e-3
"""Probability of a shape's gain, were it chance."""
MOST = 0.5
"""Share of the energy over the floor that is left where what was found is a part of it at best."""


@dataclass(frozen=True, slots=True)
class Adequacy:
    """`before`, `after`: innovation energy over the floor, without and with the effects found; `left`: the views;
    `shape`: what would still gain most by any shape, None where nothing can be said; `gained`: by the effects found;
    `struck`: parts of one of these strike each other."""

    before: float
    after: float
    left: Views | None
    shape: Shape | None = None
    log_ratio: float = 0.0
    impacts: bool = False

    @property
    def adequate(self) -> bool:
        if self.left is None or self.shaped:
            return False
        most = LEFT_BY_IMPACTS if self.impacts else LEFT
        return self.left.adequate or self.after - 1.0 <= most * (self.before - 1.0)

    @property
    def shaped(self) -> bool:
        """Whether a force without a name goes with something."""
        if self.shape is None or self.shape.p_value >= CHANCE:
            return False
        surely = self.shape.gain - SIGNIFICANT * self.shape.std
        return surely > SHAPED * self.log_ratio or self.shape.share > EXPLAINED

    @property
    def named(self) -> bool:
        """Whether what was found is more than half of what was missing."""
        # Where noise of the model's own explains what is missing, little is over the floor before and after.
        if self.left is None or self.after - 1.0 > max(MOST * (self.before - 1.0), LEFT):
            return False
        return self.shape is None or not self.shaped or self.shape.gain < self.log_ratio

    @property
    def reason(self) -> str:
        """What is left, in words."""
        if self.left is None:
            return "no predictor with the fitted values is stable"
        words = summary(self.left.fails)
        if self.shaped and self.shape is not None:
            words.insert(0, self._told(self.shape))
        return " ".join(words)

    def _told(self, shape: Shape) -> str:
        share = (
            f", {100.0 * shape.gain / self.log_ratio:.0f} % of what the named effects gained" if self.log_ratio else ""
        )
        return (
            f"A force at {shape.joint} that goes with {shape.name}, of no known shape, would still raise the log "
            f"likelihood by {shape.gain:.3g}{share}, and explains {100.0 * shape.share:.0f} % of what is left."
        )


def adequacy(first: Fit, last: Fit, log_ratio: float) -> Adequacy:
    """Of the model as it was and as it became, both beside the disturbance that the latter leaves; `gained` in log
    likelihood."""
    before = over_floor(first, last)
    try:
        task, values = shaken_as(last.problem, last.values, last)
        least = floor(task, values)
        left = innovations(task, values, least)
        seen = views(left)
        found = Innovations(last, least, tuple(last.innovations()))
        shaped = shapes(found, probe(found))
    except FAILURES:
        return Adequacy(before, float("inf"), None)
    sure = [each for each in shaped if each.p_value < CHANCE] or shaped
    impacts = any(each.effect.impacts for each in last.problem.model.effects)
    return Adequacy(before, left.ratio, seen, sure[0] if sure else None, log_ratio, impacts)


def over_floor(fitted: Fit, best: Fit, values: Array | None = None) -> float:
    """Innovation energy over the floor, beside the disturbance that the fit `best` leaves; without end where no
    predictor is stable. `values` (np,) are those of the parameters, in place of the fitted ones."""
    try:
        task, values = shaken_as(fitted.problem, fitted.values if values is None else values, best)
        return innovations(task, values, floor(task, values)).ratio
    except FAILURES:
        return float("inf")
