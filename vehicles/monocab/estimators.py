"""The regressions that run along with a MONOCAB: the torque balance of its roll axis, plain and with instruments."""

from __future__ import annotations

from collections.abc import Mapping

from estimators.contract import Estimator
from estimators.recursive import torque_balance


def regressions(parameters: Mapping[str, float], deviations: Mapping[str, float], support: float) -> list[Estimator]:
    """`parameters` are the CAD values, `deviations` their standard deviations, `support` rad the angle on a support."""
    return [
        torque_balance.make(parameters, support, method=method, deviations=deviations)
        for method in (torque_balance.Method.PLAIN, torque_balance.Method.INSTRUMENTAL)
    ]
