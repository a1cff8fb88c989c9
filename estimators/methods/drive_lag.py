"""Lag of a drive's speed loop and its compliance under load, from setpoint and measured rate.

    rate = [ setpoint - roll_reaction (s + tau s^2) body_rate ] / (1 + 4 tau s + 8 tau^2 s^2 + 8 tau^3 s^3)

is a speed loop tuned by the symmetric optimum (estimators.speed_loop). `speed_loop_lag` is 4 tau (s), the mean delay of
the loop. Rolling precesses the gimbals against their loops. `roll_reaction` (s) is the rate by which they yield per
roll acceleration, 8 tau^2 angular_momentum / gimbal_inertia: times the angular momentum it is the difference between
the apparent inertia and the mechanical one. Without it, 20 mrad/s would remain unexplained. `setpoint_offset` (s), the
delay from the sample of a setpoint until it begins to act, is a nuisance parameter. The measured rate of a sample was
taken `age` before it.

Loop.FIRST_ORDER is for drives with another tuning. For a symmetric optimum it estimates half the lag and attributes the
rest to the offset, since a first-order lag has no point of inflection.

A loop at its torque limit follows neither model. Such samples are outliers, and the fit tolerates them (Cauchy's loss).
Standard deviations are those of an M-estimator with correlated residuals (Huber and Ronchetti, Robust Statistics,
chapter 6).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from upright.estimators.contract import Estimate, ParameterEstimate, Status
from upright.estimators.numbers import about
from upright.estimators.recursive.least_squares import continue_autocovariance, positive_meat
from upright.estimators.speed_loop import LONGEST, MODES, RUN_IN, SHORTEST, Loop, Modes, Window, predict, windows_of
from upright.estimators.stopwatch import stopwatch
from upright.telemetry.recording import Recording

METHOD = "drive_lag"
PARAMETERS = ("speed_loop_lag", "setpoint_offset", "roll_reaction")
LOWER, UPPER = np.array((SHORTEST, -0.05, -1.0)), np.array((LONGEST, 0.1, 1.0))
START = np.array((0.04, 0.0, 0.0))
TYPICAL = np.array((0.01, 0.001, 0.01))
STEP_SHARE = 0.1
"""Least change of the setpoint before a sample that is used, as a share of the setpoint's whole range."""
FEWEST_ROWS = 25
REQUIRED_STD = 0.1
"""Largest standard deviation, as a share of the lag, with which a parameter counts as known."""
CORRELATED = 0.25
"""Longest correlation of the residuals, s."""
ORDER = 5
"""Lags of the residual's autocovariance that are used as measured; the others are extrapolated from these."""
ROUNDS = 20
"""Largest number of iterations of scale and fit."""
SCALE = 2.385 * 1.4826
"""Scale of Cauchy's loss over the residuals' median magnitude, for 95 % efficiency with Gaussian residuals."""

Array = NDArray[np.float64]


def drive_lag(
    recordings: Sequence[Recording],
    *,
    setpoint: str,
    rate: str,
    body_rate: str = "",
    age: str = "drive_age",
    loop: Loop = Loop.SYMMETRIC_OPTIMUM,
) -> Estimate:
    """Lag, offset and reaction of the speed loops, s, from the samples after a change of the setpoint; see the module.

    The other arguments are names of channels, in rad/s and s. With `body_rate` "" the reaction is left out, for axes
    without a load.

    Raises RecordingError if a channel is missing.
    """
    started = stopwatch()
    count = 3 if body_rate else 2
    names, channels = PARAMETERS[:count], (setpoint, rate, age, body_rate)[: count + 1]
    for recording in recordings:
        recording.require(*channels)
    known = [recording[setpoint][np.isfinite(recording[setpoint])] for recording in recordings]
    span = max((float(np.ptp(values)) for values in known if len(values)), default=0.0)
    windows: list[Window] = []
    for number, recording in enumerate(recordings):
        # Two apart, so that samples of two recordings are never adjacent.
        first = 2 * number + sum(len(before) for before in recordings[:number])
        windows += windows_of(recording, channels, STEP_SHARE * span, first) if span > 0.0 else []
    rows = sum(len(window.time) for window in windows)
    if rows < FEWEST_ROWS:
        return _refused(names, rows, setpoint, span, stopwatch() - started)
    values, jacobian, residual, weight, converged = _fit(windows, MODES[loop], count)
    covariance = _covariance(jacobian, residual, weight, windows)
    parameters = {
        name: _parameter(place, name, values, covariance, converged, setpoint) for place, name in enumerate(names)
    }
    failed = next((p for p in parameters.values() if not p.identifiable), None)
    measured = np.concatenate([window.rate for window in windows])
    spread = float(np.linalg.norm(measured - measured.mean()))
    std = np.sqrt(np.diagonal(covariance))
    return Estimate(
        METHOD,
        parameters,
        failed.status if failed else Status.OK,
        failed.reason if failed else "",
        rows,
        sum(float(window.time[-1] - window.time[0]) for window in windows),
        fit_percent={rate: 100.0 * (1.0 - float(np.linalg.norm(residual)) / spread)} if spread > 0.0 else {},
        correlation=covariance / np.outer(std, std) if (std > 0.0).all() else None,
        bounds_hit=tuple(name for name, p in parameters.items() if p.status is Status.AT_BOUND),
        seconds=stopwatch() - started,
    )


def _refused(names: Sequence[str], rows: int, setpoint: str, span: float, seconds: float) -> Estimate:
    status, why = Status.TOO_FEW_SAMPLES, f"{rows} samples follow a change of {setpoint}, {FEWEST_ROWS} are required"
    if span == 0.0:
        status, why = Status.TOO_LITTLE_EXCITATION, f"{setpoint} never moves"
    reason = f"{why}: record a step, with {RUN_IN:g} s before it"
    nothing = {name: ParameterEstimate(None, None, "s", status, 0.0, reason) for name in names}
    return Estimate(METHOD, nothing, status, reason, rows, 0.0, seconds=seconds)


def _fit(windows: Sequence[Window], modes: Modes, count: int) -> tuple[Array, Array, Array, Array, bool]:
    """Values, Jacobian, residual and weight of each sample at the robust optimum, and whether it was found."""
    last: tuple[bytes, tuple[Array, Array]] = (b"", (np.empty(0), np.empty(0)))

    def at(values: Array) -> tuple[Array, Array]:
        nonlocal last
        if last[0] != values.tobytes():
            last = (values.tobytes(), predict(windows, modes, values))
        return last[1]

    values, converged = START[:count], False
    floor = 1e-9 * max(float(np.max(np.abs(window.rate))) for window in windows) + 1e-300
    for _ in range(ROUNDS):
        scale = max(floor, SCALE * float(np.median(np.abs(at(values)[0]))))
        solution = least_squares(
            lambda x: at(x)[0],
            values,
            jac=lambda x: at(x)[1],
            bounds=(LOWER[:count], UPPER[:count]),
            x_scale=TYPICAL[:count],
            loss="cauchy",
            f_scale=scale,
        )
        moved = float(np.max(np.abs(solution.x - values) / TYPICAL[:count]))
        values, converged = solution.x, bool(solution.success) and moved < 1e-3
        if converged:
            break
    residual, jacobian = at(values)
    return values, jacobian, residual, 1.0 / (1.0 + (residual / scale) ** 2), converged


def _covariance(jacobian: Array, residual: Array, weight: Array, windows: Sequence[Window]) -> Array:
    """Covariance (p, p) of the values; NaN if they are not identifiable.

    It is that of an M-estimator, with the second derivative of the loss, and the score's autocovariance up to
    CORRELATED.
    """
    information = jacobian.T @ ((weight**2 * (2.0 - 1.0 / weight))[:, None] * jacobian)
    size = np.sqrt(np.maximum(np.diagonal(information), 0.0))
    if not (size > 0.0).all() or np.linalg.cond(information / np.outer(size, size)) > 1e10:
        return np.full_like(information, np.nan)
    number = np.concatenate([window.number for window in windows])
    longest = max(windows, key=lambda window: len(window.time)).time
    lags = round(CORRELATED / float(np.median(np.diff(longest)))) if len(longest) > 1 else 0
    score = weight * residual
    covariances, moments = [], []
    for lag in range(min(lags, len(score) - 2) + 1):
        late = np.searchsorted(number, number + lag)
        early = np.flatnonzero((late < len(number)) & (number[np.minimum(late, len(number) - 1)] == number + lag))
        late = late[early]
        covariances.append(float(score[early] @ score[late]) / max(len(early), 1))
        moment = jacobian[early].T @ jacobian[late]
        moments.append(moment if lag == 0 else moment + moment.T)
    inverse = np.linalg.inv(information)
    middle = positive_meat(continue_autocovariance(np.array(covariances), ORDER), np.array(moments))
    rows, count = jacobian.shape
    covariance: Array = inverse @ middle @ inverse * rows / (rows - count)
    return covariance


def _parameter(
    place: int, name: str, values: Array, covariance: Array, converged: bool, setpoint: str
) -> ParameterEstimate:
    value, variance = float(values[place]), float(covariance[place, place])
    if not converged:
        reason = "the fit found no minimum: the drives may be at their limit all the time"
        return ParameterEstimate(None, None, "s", Status.NOT_CONVERGED, 0.0, reason)
    if not np.isfinite(variance):
        reason = f"{name} is not identifiable from this motion of {setpoint}: record a step"
        return ParameterEstimate(None, None, "s", Status.UNIDENTIFIABLE, 0.0, reason)
    std, required = float(np.sqrt(max(variance, 0.0))), REQUIRED_STD * float(values[0])
    coverage = 100.0 * min(1.0, required / std) if std > 0.0 else 100.0
    if min(value - LOWER[place], UPPER[place] - value) < 1e-3 * TYPICAL[place]:
        reason = f"{name} is at the limit of its search range, {value:g} s: check the channels' signs and times"
        return ParameterEstimate(None, None, "s", Status.AT_BOUND, coverage, reason)
    if coverage < 100.0:
        reached, wanted = about(std, "s"), about(required, "s")
        reason = f"{name} is known only to ± {reached}, ± {wanted} is required: record larger or more steps"
        return ParameterEstimate(None, None, "s", Status.TOO_LITTLE_EXCITATION, coverage, reason)
    return ParameterEstimate(value, std, "s", Status.OK, coverage)
