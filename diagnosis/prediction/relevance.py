"""How much an effect matters: the share of a model's errors that it accounts for, however significant it is.

    share = (E without - E with) / E without

E is the mean energy of the error some time ahead, and in a simulation of the closed loop, each output over its floor,
which is that of the last model for all. All models run through one filter, that of the best model's disturbance and the
sensors' noise. A long record shows effects without which predictions and controllers would be as good: an effect that
accounts for less than a percent of both errors is negligible.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from upright.diagnosis.lack_of_fit.floor import Innovations, floor, innovations, shaken_as
from upright.diagnosis.prediction.ahead import errors, sensor_floors
from upright.diagnosis.prediction.closed_loop_error import ClosedLoop, Loop, closed_loop
from upright.diagnosis.trial import FAILURES
from upright.estimators.contract import EstimationError
from upright.estimators.data.time_scale import horizon
from upright.estimators.fit.maximum_likelihood import Fit

DRAWS = 1
"""Draws of the noise in the loop: one is enough to weigh the error of one channel against that of another."""
NEGLIGIBLE = 1.0
"""Percent of an error's energy below which an effect is negligible."""


@dataclass(frozen=True, slots=True)
class Relevance:
    """Percent of the error energy that an effect accounts for: `ahead`, `horizon` s ahead, and in the `closed_loop`,
    None if no loop could be simulated with and without it. The model without it has all that was found before."""

    horizon: float
    ahead: float
    closed_loop: float | None = None

    @property
    def negligible(self) -> bool:
        """Whether it accounts for less than NEGLIGIBLE of either error."""
        return max(self.ahead, self.closed_loop or 0.0) < NEGLIGIBLE

    def to_json(self) -> dict[str, Any]:
        """`relevance` of a finding in `diagnose --json`."""
        return {
            "horizon": self.horizon,
            "ahead_percent": self.ahead,
            "closed_loop_percent": self.closed_loop,
            "negligible": self.negligible,
        }

    def __str__(self) -> str:
        """`It accounts for 43 % of the error energy 0.5 s ahead, and for 70 % of that in the closed loop.`"""
        shares = [f"{percent(self.ahead)} of the error energy {self.horizon:g} s ahead"]
        if self.closed_loop is not None:
            shares.append(f"{percent(self.closed_loop)} of that in the closed loop")
        return f"It accounts for {', and for '.join(shares)}{': negligible' if self.negligible else ''}."


def relevances(
    steps: Sequence[Fit], best: Fit, owners: Sequence[int] = (), loops: Sequence[Loop | str] = ()
) -> list[Relevance | None]:
    """Relevance of what each of `steps` adds to the one before it; None if it cannot be computed.

    `best` is the fit whose disturbance is the vehicle's; `owners` gives the recording of each segment, and `loops` the
    controller that closed the loop on each recording, or why that is not known."""
    seen = [_seen(each, best) for each in steps]
    reach = horizon(best.problem.model, best.problem.segments)
    least = _least(seen[-1], reach) if seen else None
    ahead = [None if each is None or least is None else _ahead(each, reach, least) for each in seen]
    looped = _looped(seen, owners, loops)
    found: list[Relevance | None] = []
    for place in range(1, len(steps)):
        share = _share(ahead[place - 1], ahead[place])
        found.append(None if share is None else Relevance(reach, share, _share(looped[place - 1], looped[place])))
    return found


def _seen(fitted: Fit, best: Fit) -> Innovations | None:
    try:
        task, values = shaken_as(fitted.problem, fitted.values, best)
        return innovations(task, values, floor(task, values))
    except FAILURES:
        return None


def _least(found: Innovations | None, reach: float) -> NDArray[np.float64] | None:
    """The floor of each output `reach` s ahead, (p,)."""
    try:
        return None if found is None else sensor_floors(found.fit, (reach,))[0]
    except EstimationError:
        return None


def _ahead(found: Innovations, reach: float, least: NDArray[np.float64]) -> float | None:
    """Mean energy of the error `reach` s ahead over that of `least`, of all outputs."""
    ahead = errors(found.fit, (reach,))[0]
    if not np.isfinite(ahead).any(axis=0).all():  # no segment is as long as that
        return None
    mean = float(np.mean(np.nanmean((ahead / least) ** 2, axis=0)))
    return mean if np.isfinite(mean) else None


def _looped(
    seen: Sequence[Innovations | None], owners: Sequence[int], loops: Sequence[Loop | str]
) -> list[float | None]:
    """Mean energy of each model's error in the closed loop, over that from noise alone, of all channels; the latter is
    that of the last model, which has most effects, for all."""
    best = closed_loop(seen[-1], owners, loops, draws=DRAWS) if seen and seen[-1] is not None and loops else None
    if best is None or best.reason:
        return [None] * len(seen)
    before = [None if each is None else closed_loop(each, owners, loops, floor=best.floor) for each in seen[:-1]]
    return [None if each is None else _in_loop(each) for each in (*before, best)]


def _in_loop(loop: ClosedLoop) -> float | None:
    return None if loop.reason else float(np.mean([loop.over_floor(channel) ** 2 for channel in loop.measured]))


def _share(without: float | None, with_it: float | None) -> float | None:
    if without is None or with_it is None or without <= 0.0:
        return None
    return float(100.0 * max(0.0, without - with_it) / without)


def percent(share: float) -> str:
    """`43 %`; less than one percent with one digit."""
    return f"{share:.0f} %" if share >= 1.0 else f"{share:.1g} %" if share > 0.0 else "none"
