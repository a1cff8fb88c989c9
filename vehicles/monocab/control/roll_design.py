"""The reduced LQI of a MONOCAB, designed on its linear model and checked at every corner of its uncertain parameters.

Source: Griese et al., section II, with the gimbals' whole speed loop where the paper has one lag; the design itself is
models.control_design.lqi.
"""

from __future__ import annotations

from dataclasses import dataclass

from upright.models.control_design.lqi import LqiWeights
from upright.models.control_design.robustness import CheckedDesign, Known, Spread, checked_design
from upright.vehicles.monocab.control.linear_model import MonocabParameters, reduced_model

UNCERTAIN = ("inertia", "gravity_stiffness", "speed_loop_lag")
"""Parameters whose CAD values are uncertain; the angular momentum is known from the flywheels' speed."""


@dataclass(frozen=True, slots=True)
class RollDesign(CheckedDesign):
    """A roll controller with its checks, and the `parameters` for which it was designed."""

    parameters: MonocabParameters


def design_roll_controller(
    parameters: MonocabParameters,
    weights: LqiWeights,
    period: float,
    *,
    spread: float = 0.2,
    known: Known | None = None,
) -> RollDesign:
    """The reduced LQI of the paper for a vehicle, checked `spread` around its uncertain parameters, or wherever these
    may be if they are `known` from estimates.

    Weights are of the states of `reduced_model`. Raises ControlDesignError.
    """
    uncertain = known.about(UNCERTAIN) if known else Spread(UNCERTAIN, spread)
    found = checked_design(lambda factors: reduced_model(parameters.scaled(factors)), uncertain, weights, period)
    return RollDesign(found.gains, found.poles, found.margins, found.worst, found.within, parameters)
