"""The reduced LQI of a MONOCAB, designed on its linear model and judged at every corner of its uncertain parameters.

Source: Griese et al., section II; the design itself is models.control_design.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

from models.control_design import (
    ControlDesignError,
    LqiGains,
    LqiWeights,
    Margins,
    closed_loop,
    continuous_poles,
    damping_and_decay,
    design_lqi,
    margins,
)
from vehicles.monocab.control.linear_model import MonocabParameters, reduced_model

UNCERTAIN = ("inertia", "gravity_stiffness", "speed_loop_lag")
"""Parameters whose CAD values are not to be trusted; the angular momentum is known from the flywheels' speed."""


@dataclass(frozen=True, slots=True)
class Corner:
    """The closed loop at one corner of the uncertain parameters.

    `factors` holds (parameter, factor on its nominal value); `delay` s in all; `damping` is the worst damping ratio,
    `slowest` (1/s) the decay rate of the slowest pole, negative where the loop is unstable.
    """

    factors: tuple[tuple[str, float], ...]
    delay: float
    damping: float
    slowest: float

    def __str__(self) -> str:
        values = ", ".join(f"{name} x {factor:g}" for name, factor in self.factors)
        return (
            f"{values}, delay {self.delay * 1e3:g} ms: damping {self.damping:.2f}, slowest pole {self.slowest:.2f} 1/s"
        )


@dataclass(frozen=True, slots=True)
class RollDesign:
    """A roll controller with what is known about it. `poles` (1/s) are those of the nominal closed loop."""

    gains: LqiGains
    parameters: MonocabParameters
    poles: tuple[complex, ...]
    margins: Margins
    worst: Corner


def corners(
    parameters: MonocabParameters, gains: LqiGains, spread: float, uncertain: Sequence[str] = UNCERTAIN
) -> Iterator[Corner]:
    """The closed loop `spread` (0.2: 20 %) to either side of every uncertain parameter, one and two periods late."""
    for factors in itertools.product((1.0 - spread, 1.0 + spread), repeat=len(uncertain)):
        values = {name: getattr(parameters, name) * f for name, f in zip(uncertain, factors, strict=True)}
        model = reduced_model(replace(parameters, **values))
        for delay_periods in (1, 2):
            poles = continuous_poles(closed_loop(model, gains, delay_periods), gains.period)
            damping, slowest = damping_and_decay(poles)
            yield Corner(tuple(zip(uncertain, factors, strict=True)), delay_periods * gains.period, damping, slowest)


def design_roll_controller(
    parameters: MonocabParameters, weights: LqiWeights, period: float, *, spread: float = 0.2
) -> RollDesign:
    """The reduced LQI of the paper (section II) for a vehicle, checked over the uncertainty of its parameters.

    Weights are of [roll, roll_rate, precession_rate]. Raises ControlDesignError where no controller is found or where
    it is unstable at a corner; the message names the corner.
    """
    model = reduced_model(parameters)
    gains = design_lqi(model.A, model.B, model.C, weights, period)
    worst = min(corners(parameters, gains, spread), key=lambda corner: (corner.slowest > 0.0, corner.damping))
    if worst.slowest <= 0.0:
        raise ControlDesignError(
            f"the controller falls over where the vehicle differs from its CAD values ({worst}).",
            remedy="raise effort_weight (less bandwidth) or the control rate, or narrow the CAD values' uncertainty.",
        )
    poles = continuous_poles(closed_loop(model, gains), period)
    return RollDesign(gains, parameters, tuple(complex(pole) for pole in poles), margins(model, gains), worst)
