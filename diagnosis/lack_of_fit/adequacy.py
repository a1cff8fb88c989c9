"""Is anything left in the innovations of a model that chance does not explain, whatever its name?

The reference is the floor: what a correct model would leave, given the noise that the record itself shows. The four
views of where_it_fails test against it at one per cent in total. No formula is exact, however, and a long record shows
that real friction does not quite follow its formula. What a named effect leaves of the energy over the floor therefore
counts as a failure only above a certain share.

A wrong neighbour closes most of the gap, too, so a small remainder proves no name. Forces of any shape
(diagnosis.lack_of_fit.shapes) are therefore tried beside the named effects: if one of them raises the log-likelihood by
a good part of what the named effects did, the names are wrong.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from upright.diagnosis.evidence import SIGNIFICANT
from upright.diagnosis.lack_of_fit.floor import Innovations, floor, innovations, shaken_as
from upright.diagnosis.lack_of_fit.force_probe import probe
from upright.diagnosis.lack_of_fit.shapes import Shape, shapes
from upright.diagnosis.lack_of_fit.where_it_fails import Views, summary, views
from upright.diagnosis.trial import FAILURES
from upright.estimators.fit.maximum_likelihood import Fit

Array = NDArray[np.float64]

LEFT = 0.05
"""Share of the energy over the floor, before anything was added, that a correctly named effect may leave."""
LEFT_BY_IMPACTS = 0.3
"""The same if parts collide: an impact that is predicted a sample early or late is an error of dozens of standard
deviations. Backlash of a gear, correctly named, left 12 to 23 % on six records, another name 90 % and more."""
SHAPED = 0.12
"""Rise of the log-likelihood that a shape without a name may add, as a share of the rise by the named effects.

Dry friction with bristles leaves 2 to 11 % of the rise by tanh, a wrong name 17 % and more. The rise has to exceed that
share significantly: 30 % of 50 nats may be 4 % on a short record."""
EXPLAINED = 0.5
"""Share of the remaining energy that a shape without a name may explain. The friction of an axis, correctly named,
leaves a remainder of which a curve over the rate explains a fifth; of what cubic drag leaves, if called quadratic, it
explains nine tenths.

If a record shows much of an effect, the error of its formula is far above the noise, and the estimated noise absorbs
it: the rise of the log-likelihood then says little."""
CHANCE = 1e-3
"""p-value below which the rise by a shape is not attributed to chance."""
MOST = 0.5
"""Share of the energy over the floor: if more than this is left, the effects found explain a part at best."""


@dataclass(frozen=True, slots=True)
class Adequacy:
    """`before`, `after`: innovation energy over the floor, without and with the effects found. `left`: the views.
    `shape`: the shape of a force that would raise the log-likelihood most, None if no statement is possible.
    `log_ratio`: rise of the log-likelihood by the effects found. `impacts`: one of these has colliding parts."""

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
        """Whether a force without a name significantly depends on a coordinate or on time."""
        if self.shape is None or self.shape.p_value >= CHANCE:
            return False
        lower = self.shape.log_ratio - SIGNIFICANT * self.shape.std
        return lower > SHAPED * self.log_ratio or self.shape.share > EXPLAINED

    @property
    def named(self) -> bool:
        """Whether the effects found explain more than half of what was missing."""
        # If the model's own noise explains what is missing, little is over the floor before and after.
        if self.left is None or self.after - 1.0 > max(MOST * (self.before - 1.0), LEFT):
            return False
        return self.shape is None or not self.shaped or self.shape.log_ratio < self.log_ratio

    @property
    def reason(self) -> str:
        """What is left unexplained, in words."""
        if self.left is None:
            return "no predictor with the fitted values is stable"
        words = summary(self.left.fails)
        if self.shaped and self.shape is not None:
            words.insert(0, self._about(self.shape))
        return " ".join(words)

    def _about(self, shape: Shape) -> str:
        share = (
            f" ({100.0 * shape.log_ratio / self.log_ratio:.0f} % of the rise by the named effects)"
            if self.log_ratio
            else ""
        )
        return (
            f"A force at {shape.joint} that depends on {shape.name}, of no known shape, would raise the log-likelihood "
            f"by another {shape.log_ratio:.3g}{share} and explains {100.0 * shape.share:.0f} % of what is left."
        )


def adequacy(first: Fit, last: Fit, log_ratio: float) -> Adequacy:
    """Adequacy of the model as it was (`first`) and as it became (`last`), both with the disturbance that the latter
    leaves; `log_ratio` is the rise of the log-likelihood."""
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
    significant = [each for each in shaped if each.p_value < CHANCE] or shaped
    impacts = any(each.effect.impacts for each in last.problem.model.effects)
    return Adequacy(before, left.ratio, seen, significant[0] if significant else None, log_ratio, impacts)


def over_floor(fitted: Fit, best: Fit, values: Array | None = None) -> float:
    """Innovation energy over the floor, with the disturbance that the fit `best` leaves; infinite if no predictor is
    stable. `values` (np,) replace the fitted parameter values."""
    try:
        task, values = shaken_as(fitted.problem, fitted.values if values is None else values, best)
        return innovations(task, values, floor(task, values)).ratio
    except FAILURES:
        return float("inf")
