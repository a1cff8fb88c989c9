"""Inertia, gravity stiffness and static torque of the MONOCAB while it runs: regression on its torque balance.

    angular_momentum * precession' + trim torque = inertia * roll'' - gravity_stiffness * roll - static_torque

The left side is known: the angular momentum fixes the scale, and its uncertainty is added to the result. The rows of
the regression, and when the vehicle obeys them, are in vehicles.monocab.identification.balance_rows.

Two forms. Plain least squares is biased if noise on roll'' is not small compared with roll'' (the paper's finding); the
instrumental-variable form replaces the regressors by signals that follow from the injected excitation only, so that
neither sensor noise nor a disturbance in the closed loop can bias it. It needs an injected excitation that is known at
every instant; the plain form needs only motion, and only what was on the bus: a raw log alone gives the same numbers
bit for bit.

`drive_time_offset` is given along with the three, but it is a nuisance parameter: fitted so that a misalignment of a
fraction of a sample does not bias them. It is not a parameter of the vehicle, no model uses it, and it need not be
identifiable.

Source: Griese et al., section III-B, equations (6) and (7).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum

import numpy as np

from upright.estimators.contract import Estimate, EstimationError, ParameterEstimate, Status
from upright.estimators.recursive.least_squares import Prior, RecursiveLeastSquares, Solution
from upright.telemetry.channels import ChannelTable
from upright.telemetry.samples import Frame
from upright.vehicles.monocab.identification.balance_rows import REGRESSORS, BalanceRows, FilterConfig

UNITS = dict(zip(REGRESSORS, ("kg m^2", "N m/rad", "N m", "s"), strict=True))
TERMS = dict(
    zip(
        REGRESSORS,
        ("the roll acceleration", "the roll angle", "the constant", "the precession acceleration"),
        strict=True,
    )
)
NUISANCE = "drive_time_offset"
"""The only result that is not a parameter of the vehicle, see above."""


class Method(StrEnum):
    """The two forms, by the names of their results."""

    PLAIN = "recursive_least_squares"
    INSTRUMENTAL = "recursive_instrumental_variables"


@dataclass(frozen=True, slots=True)
class TorqueBalanceConfig:
    """Settings of the regression; none depends on the values to be estimated.

    `correlation_time` s: how long the residual can be correlated, a few times that of the roll filter's corrections.
    `memory` s: time constant of forgetting. `required_share`: each term of the balance must move independently by this
    share of the gravity torque at the support, RMS. `shortest_span` s of free motion before a result is given.
    """

    filter: FilterConfig = field(default_factory=FilterConfig)
    correlation_time: float = 4.0
    memory: float = np.inf
    required_share: float = 0.02
    shortest_span: float = 0.4


class TorqueBalance:
    """Estimator of inertia, gravity stiffness and static torque from the control cycles of a MONOCAB.

    `parameters` needs angular_momentum, trim_mass, trim_height, and inertia and gravity_stiffness as start values (they
    scale the required excitation and, with forgetting, bound the result). `deviations` are their standard deviations,
    if known. `support` is the roll angle, rad, at which the supports carry.
    Raises EstimationError if a parameter is missing or not positive, or the support angle leaves no free range.
    """

    def __init__(
        self,
        parameters: Mapping[str, float],
        support: float,
        *,
        method: Method = Method.PLAIN,
        deviations: Mapping[str, float] | None = None,
        channels: ChannelTable,
        config: TorqueBalanceConfig | None = None,
    ) -> None:
        for name in ("inertia", "gravity_stiffness", "angular_momentum"):
            if not parameters.get(name, 0.0) > 0.0:
                remedy = "set it in [parameters] of the vehicle file."
                raise EstimationError(f"parameter {name}", "must be given and positive", remedy=remedy)
        self._method = method
        self._config = config = config or TorqueBalanceConfig()
        instrumental = method is Method.INSTRUMENTAL
        self._rows = BalanceRows(parameters, support, channels, config.filter, instruments=instrumental)
        deviations = deviations or {}
        self._momentum_share = deviations.get("angular_momentum", 0.0) / parameters["angular_momentum"]
        inertia, stiffness = parameters["inertia"], parameters["gravity_stiffness"]
        heaviest = stiffness * support
        required = config.required_share * heaviest
        # The constant and the nuisance need not move much: it is enough that they are distinguished from the rest.
        self._required = np.array([required / inertia, required / stiffness, 0.1, 0.1 * required])
        prior = None
        if config.memory < np.inf:
            spread = [deviations.get("inertia", 0.3 * inertia), deviations.get("gravity_stiffness", 0.3 * stiffness)]
            prior = Prior(
                values=np.array([inertia, stiffness, 0.0, 0.0]),
                std=np.array([*spread, heaviest, 0.01]),
                residual_std=0.01 * heaviest,
            )
        self._regression = RecursiveLeastSquares(
            len(REGRESSORS),
            instruments=BalanceRows.INSTRUMENTS if instrumental else 0,
            lags=round(config.correlation_time / config.filter.stride),
            memory=config.memory / config.filter.stride,
            prior=prior,
        )

    @property
    def method(self) -> str:
        return self._method.value

    def reset(self) -> None:
        """Forget all cycles."""
        self._rows.reset()
        self._regression.reset()

    def update(self, frame: Frame) -> None:
        """Take one control cycle; those on the support, out of order or with unknown values are ignored."""
        row = self._rows.update(frame)
        if row is None:
            return
        if row.begins:
            self._regression.interrupt()
        self._regression.update(row.output, row.regressors, row.instruments)

    def result(self) -> Estimate:
        """Inertia, gravity stiffness and static torque with standard deviations, and the NUISANCE fitted along."""
        span = self._rows.free_time
        if span < self._config.shortest_span:
            return self._no_result(span)
        solution = self._regression.solve()
        parameters = {name: self._parameter(place, name, solution) for place, name in enumerate(REGRESSORS)}
        failed = next((p for name, p in parameters.items() if not p.identifiable and name != NUISANCE), None)
        status, reason = (failed.status, failed.reason) if failed else (Status.OK, "")
        return Estimate(self.method, parameters, status, reason, round(self._regression.samples), span)

    def _no_result(self, span: float) -> Estimate:
        cycles, unknown = self._rows.cycles, self._rows.unknown_excitation
        if 2 * unknown > cycles:
            lacking = Status.MISSING_CHANNEL
            reason = (
                f"the excitation is unknown in {unknown} of {cycles} control cycles, and this form needs it: it is not "
                f"on the bus, so a raw log does not contain it; keep the .arrow beside it, or use {Method.PLAIN.value}"
            )
        else:
            lacking = Status.TOO_FEW_SAMPLES
            where = "the vehicle has hardly left its supports" if cycles else "no control cycle has come in yet"
            reason = f"{span:.1f} s of free motion, {self._config.shortest_span:g} s needed: {where}"
        parameters = {name: ParameterEstimate(None, None, unit, lacking, 0.0, reason) for name, unit in UNITS.items()}
        return Estimate(self.method, parameters, lacking, reason, round(self._regression.samples), span)

    def _parameter(self, place: int, name: str, solution: Solution) -> ParameterEstimate:
        unit = UNITS[name]
        coverage = 100.0 * min(1.0, float(solution.movement[place] / self._required[place]))
        if coverage < 100.0:
            means = "with the injected excitation" if self._regression.instruments else "independently of the rest"
            reason = (
                f"{TERMS[name]} moves {means} at {coverage:.0f} % of what is needed: "
                "use a stronger or broader excitation"
            )
            return ParameterEstimate(None, None, unit, Status.TOO_LITTLE_EXCITATION, coverage, reason)
        value, variance = float(solution.values[place]), float(solution.covariance[place, place])
        if name in ("inertia", "gravity_stiffness") and value <= 0.0:
            reason = f"{name} comes out as {value:.4g} {unit}, which no vehicle has: check the sensors' signs and axes"
            return ParameterEstimate(None, None, unit, Status.IMPLAUSIBLE, coverage, reason)
        if name != NUISANCE:
            # The balance gives its parameters in units of the angular momentum, whose uncertainty applies to them, too.
            variance += (value * self._momentum_share) ** 2
        if not 0.0 <= variance < np.inf:
            reason = f"the deviation of {name} cannot be determined from {solution.samples:.0f} rows: record for longer"
            return ParameterEstimate(None, None, unit, Status.TOO_FEW_SAMPLES, coverage, reason)
        return ParameterEstimate(value, float(np.sqrt(variance)), unit, Status.OK, coverage)


def make(
    parameters: Mapping[str, float],
    support: float,
    *,
    method: Method = Method.PLAIN,
    deviations: Mapping[str, float] | None = None,
    channels: ChannelTable,
    memory: float = np.inf,
) -> TorqueBalance:
    """The live estimator of a MONOCAB, see TorqueBalance. `memory` s is the time constant of forgetting."""
    config = TorqueBalanceConfig(memory=memory)
    return TorqueBalance(parameters, support, method=method, deviations=deviations, channels=channels, config=config)
