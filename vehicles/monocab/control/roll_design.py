"""The reduced LQI of a MONOCAB, designed on its linear model and checked at every corner of its uncertain parameters.

Source: Griese et al., section II; the design itself is models.control_design.lqi.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import degrees
from typing import Any

from upright.models.control_design.lqi import LqiWeights, closed_loop, continuous_poles
from upright.models.control_design.robustness import CheckedDesign, Known, Margins, Spread, checked_design, margins
from upright.vehicles.monocab.control.linear_model import MonocabParameters, model_with_speed_loop, reduced_model

UNCERTAIN = ("inertia", "gravity_stiffness", "speed_loop_lag")
"""Parameters whose CAD values are uncertain; the angular momentum is known from the flywheels' speed."""


@dataclass(frozen=True, slots=True)
class RollDesign(CheckedDesign):
    """A roll controller with its checks, and the `parameters` for which it was designed.

    It is designed and checked with one lag in place of the speed loop, as in the paper. `with_speed_loop` are its
    margins with the speed loop that a drive has by the symmetric optimum, which is later at high frequencies; None if
    the closed loop is not stable with it.
    """

    parameters: MonocabParameters
    with_speed_loop: Margins | None

    def findings(self) -> dict[str, Any]:
        """As of CheckedDesign, with `with_speed_loop`: the margins with the speed loop by the symmetric optimum, null
        if the closed loop is not stable with it."""
        found = self.with_speed_loop
        margins = found and {
            "gain_margin": [found.gain_decrease, found.gain_increase],
            "phase_margin": found.phase,
            "delay_margin": found.delay,
        }
        return CheckedDesign.findings(self) | {"with_speed_loop": margins}

    def words(self, name: str = "") -> list[str]:
        """As of CheckedDesign, with a line for the speed loop by the symmetric optimum."""
        found = self.with_speed_loop
        what = (
            "NOT STABLE"
            if found is None
            else (
                f"gain margins {found.gain_decrease:.2f} and {found.gain_increase:.1f}, phase margin"
                f" {degrees(found.phase):.0f} deg, delay margin {1e3 * found.delay:.0f} ms"
            )
        )
        first, *others = CheckedDesign.words(self, name)
        return [first, f"{f'{name} controller'.strip()} with a speed loop by the symmetric optimum: {what}", *others]


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

    Weights are of [roll, roll_rate, precession_rate]. Raises ControlDesignError.
    """
    uncertain = known.about(UNCERTAIN) if known else Spread(UNCERTAIN, spread)
    found = checked_design(lambda factors: reduced_model(parameters.scaled(factors)), uncertain, weights, period)
    plant = uncertain.plant(lambda factors: model_with_speed_loop(parameters.scaled(factors)), {})
    poles = continuous_poles(closed_loop(plant, found.gains), period)
    (with_loop,) = margins(plant, found.gains).values() if max(pole.real for pole in poles) < 0.0 else (None,)
    return RollDesign(found.gains, found.poles, found.margins, found.worst, found.within, parameters, with_loop)
