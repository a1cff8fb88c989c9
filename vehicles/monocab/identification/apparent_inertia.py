"""The apparent inertia: that of the torque balance if only the setpoint of the precession rate is known.

    apparent inertia = inertia + 8 tau^2 angular_momentum^2 / gimbal_inertia,    tau = speed_loop_lag / 4

Rolling makes the gimbals precess a little against their speed loops, which acts like additional inertia (Griese et al.,
section II). An estimate that uses the measured precession rate gives the mechanical inertia; a controller and the
reduced model see the apparent one. It is obtained in two ways, kg m^2: by the formula, from CAD values of the gimbals,
or from the reaction that `drive_lag` measures, without CAD values: inertia + angular_momentum * roll_reaction.
"""

from __future__ import annotations

import math

from upright.estimators.contract import EstimationError, ParameterEstimate, Status
from upright.estimators.numbers import with_error
from upright.vehicles.monocab.control.linear_model import apparent_inertia

UNIT = "kg m^2"


def apparent_inertia_estimate(
    inertia: ParameterEstimate,
    lag: ParameterEstimate,
    angular_momentum: tuple[float, float],
    gimbal_inertia: tuple[float, float],
) -> ParameterEstimate:
    """The apparent inertia by the formula, from an estimate of the mechanical `inertia` and one of `speed_loop_lag`.

    `angular_momentum` (N m s) and `gimbal_inertia` (kg m^2, both gimbals with their rotors) are value and standard
    deviation. To first order in the deviations, which are taken as independent. If inertia or lag is not known,
    neither is the apparent inertia, for the same reason.

    Raises EstimationError if a value is not positive or a deviation negative.
    """
    for name, (value, std) in (("angular_momentum", angular_momentum), ("gimbal_inertia", gimbal_inertia)):
        if not (0.0 < value < math.inf and 0.0 <= std < math.inf):
            remedy = "give it in [parameters] of the vehicle file."
            raise EstimationError(f"parameter {name}", f"cannot be {with_error(value, std)}", remedy=remedy)
    if inertia.value is None or inertia.std is None:
        return _unknown("inertia", inertia)
    if lag.value is None or lag.std is None:
        return _unknown("speed_loop_lag", lag)
    value = apparent_inertia(inertia.value, angular_momentum[0], lag.value, gimbal_inertia[0])
    added = value - inertia.value
    relative = (
        2.0 * lag.std / lag.value,
        2.0 * angular_momentum[1] / angular_momentum[0],
        gimbal_inertia[1] / gimbal_inertia[0],
    )
    std = math.hypot(inertia.std, *(added * share for share in relative))
    return ParameterEstimate(value, std, UNIT, Status.OK, min(inertia.coverage_percent, lag.coverage_percent))


def measured_apparent_inertia(
    inertia: ParameterEstimate, reaction: ParameterEstimate, angular_momentum: tuple[float, float]
) -> ParameterEstimate:
    """The apparent inertia from `roll_reaction` (s) of `drive_lag`; the rest as in `apparent_inertia_estimate`."""
    momentum, momentum_std = angular_momentum
    if inertia.value is None or inertia.std is None:
        return _unknown("inertia", inertia)
    if reaction.value is None or reaction.std is None:
        return _unknown("roll_reaction", reaction)
    std = math.hypot(inertia.std, momentum * reaction.std, momentum_std * reaction.value)
    coverage = min(inertia.coverage_percent, reaction.coverage_percent)
    return ParameterEstimate(inertia.value + momentum * reaction.value, std, UNIT, Status.OK, coverage)


def _unknown(name: str, lacking: ParameterEstimate) -> ParameterEstimate:
    reason = f"{name} is not known: {lacking.reason}"
    return ParameterEstimate(None, None, UNIT, lacking.status, lacking.coverage_percent, reason)
