"""Force balance of a servo axis: mass, viscous and Coulomb friction and a force offset, sample by sample.

    force = mass * position'' + viscous_friction * position' + coulomb_friction * sign(position') + force_offset

The same filter and the same least squares as the MONOCAB's torque balance, with other regressors. Two filters are in
series: the first, wide one gives velocity and acceleration; the sign of its velocity is then a signal of its own. The
second, narrow one limits all of them to the band in which the axis moves. SI units (m, N), or rad and N m.

Source: Gautier, Janot and Vandanjon, A new closed-loop output error method for parameter identification of robot
dynamics, IEEE Trans. Control Syst. Technol. 21 (2013): inverse dynamic model, filtered in parallel.
"""

from __future__ import annotations

import numpy as np

from upright.estimators.contract import Estimate, ParameterEstimate, Status
from upright.estimators.data.state_variable_filter import StateVariableFilter
from upright.estimators.recursive.least_squares import RecursiveLeastSquares
from upright.telemetry.channels import ChannelTable
from upright.telemetry.samples import Frame

UNITS = {"mass": "kg", "viscous_friction": "N s/m", "coulomb_friction": "N", "force_offset": "N"}


class AxisBalance:
    """Estimator of a servo axis from its `position` and `force` channels.

    `motion_bandwidth` rad/s is that of the differentiating filter: well above the motion, below the encoder's noise.
    `bandwidth` rad/s is that of the regression: the band in which the axis moves. `required_force` N: each term must
    move by this much, RMS, independently of the others. `correlation_time` s: that of the residual.
    """

    method = "recursive_least_squares"

    def __init__(
        self,
        channels: ChannelTable,
        *,
        motion_bandwidth: float = 2.0 * np.pi * 100.0,
        bandwidth: float = 2.0 * np.pi * 10.0,
        required_force: float = 1.0,
        longest_gap: float = 0.02,
        correlation_time: float = 2.0,
    ) -> None:
        self._places = channels.index_of("position"), channels.index_of("force")
        self._motion = StateVariableFilter(2, motion_bandwidth)
        self._balance = StateVariableFilter(4, bandwidth)
        self._stride = 0.2 * np.pi / bandwidth
        self._longest_gap = longest_gap
        self._required_force = required_force
        self._regression = RecursiveLeastSquares(len(UNITS), lags=round(correlation_time / self._stride))
        self.reset()

    def reset(self) -> None:
        """Discard all samples."""
        self._regression.reset()
        self._time: int | None = None
        self._next = 0.0
        self._span = 0.0

    def update(self, frame: Frame) -> None:
        """Take one sample; the filters restart after a gap or an unknown value."""
        position, force = (frame.values[place] for place in self._places)
        if not (np.isfinite(position) and np.isfinite(force)):
            self._time = None
            return
        spacing = (frame.timestamp_ns - self._time) * 1e-9 if self._time is not None else np.inf
        if spacing <= 0.0:
            return
        self._time = frame.timestamp_ns
        if spacing > self._longest_gap:
            self._motion.start((position, force))
            self._balance.start((force, 0.0, 0.0, 0.0))
            self._regression.interrupt()
            self._next = 0.0
            return
        self._motion.update(spacing, (position, force))
        motion = self._motion.outputs()
        velocity = motion[1, 0]
        self._balance.update(spacing, (motion[0, 1], motion[2, 0], velocity, np.sign(velocity)))
        self._span += spacing
        self._next -= spacing
        if self._next <= 0.0:
            self._next += self._stride
            force_, *terms = self._balance.outputs()[0]
            self._regression.update(force_, terms)

    def result(self) -> Estimate:
        """Mass, friction and offset, with standard deviations."""
        samples = round(self._regression.samples)
        if samples <= 4 * len(UNITS):
            reason = f"{samples} rows of the force balance, more than {4 * len(UNITS)} are needed"
            few = Status.TOO_FEW_SAMPLES
            unknown = {name: ParameterEstimate(None, None, unit, few, 0.0, reason) for name, unit in UNITS.items()}
            return Estimate(self.method, unknown, few, reason, samples, self._span)
        solution = self._regression.solve()
        parameters = {}
        for place, (name, unit) in enumerate(UNITS.items()):
            value = float(solution.values[place])
            # The term of the offset is constant, one: it must differ from the others by a tenth of itself.
            moved = 10.0 if name == "force_offset" else abs(value) / self._required_force
            coverage = 100.0 * min(1.0, float(solution.movement[place]) * moved)
            if coverage < 100.0:
                reason = f"the term of {name} moves at {coverage:.0f} % of what is needed: move the axis more"
                status = Status.TOO_LITTLE_EXCITATION
                parameters[name] = ParameterEstimate(None, None, unit, status, coverage, reason)
            elif not 0.0 <= (variance := float(solution.covariance[place, place])) < np.inf:
                reason = f"{samples} samples do not identify the deviation of {name}: record for longer"
                parameters[name] = ParameterEstimate(None, None, unit, Status.TOO_FEW_SAMPLES, coverage, reason)
            else:
                parameters[name] = ParameterEstimate(value, float(np.sqrt(variance)), unit, Status.OK, coverage)
        failed = next((p for p in parameters.values() if not p.identifiable), None)
        status, reason = (failed.status, failed.reason) if failed else (Status.OK, "")
        return Estimate(self.method, parameters, status, reason, samples, self._span)
