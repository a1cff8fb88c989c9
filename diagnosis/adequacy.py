"""Is anything left in the innovations of a model that chance does not explain, whatever its name?

The measure is the floor: what a right model would leave, by the noise that the record itself shows. The four views of
where_it_fails test it at one per cent in all. No formula is exact, though, and a long record shows that real friction
is not quite its formula: what a named effect leaves of the energy over the floor is a failure above a share of it.
"""

from __future__ import annotations

from dataclasses import dataclass

from diagnosis.floor import floor, innovations
from diagnosis.where_it_fails import Views, summary, views
from estimators.contract import EstimationError
from estimators.methods.prediction_error import Fit

LEFT = 0.05
"""Share of the energy over the floor, before anything was added, that an effect by its right name may leave."""


@dataclass(frozen=True, slots=True)
class Adequacy:
    """`before`, `after`: innovation energy over the floor, without and with the effects found; `left`: the views."""

    before: float
    after: float
    left: Views | None

    @property
    def adequate(self) -> bool:
        if self.left is None:
            return False
        return self.left.adequate or self.after - 1.0 <= LEFT * (self.before - 1.0)

    @property
    def reason(self) -> str:
        """What is left, in words."""
        if self.left is None:
            return "no predictor with the fitted values is stable"
        return " ".join(summary(self.left.fails))


def adequacy(first: Fit, last: Fit) -> Adequacy:
    """Of the model as it was and as it became."""
    try:
        task, values = first.problem, first.values
        before = innovations(task, values, floor(task, values)).ratio
    except EstimationError:
        before = float("inf")
    try:
        task, values = last.problem, last.values
        left = innovations(task, values, floor(task, values))
    except EstimationError:
        return Adequacy(before, float("inf"), None)
    return Adequacy(before, left.ratio, views(left))
