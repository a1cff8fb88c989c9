"""Least squares on a joint's balance, all terms through one state-variable filter: the paper's plain time-domain form.

    known_F = sum_j parameter_j * regressor_j,F         F(s) = w^2 / (s^2 + sqrt(2) w s + w^2)

The filter starts at rest at the beginning of each segment, so the balance holds for the filtered terms from the first
sample on. Noise on a regressor biases the result: the differentiated gyro noise makes the inertia too small, and the
more so the wider the filter (Griese et al., section IV). This bias is inherent to the method and is not corrected here;
`instrumental_variables` and `prediction_error` do not have it. Standard deviations account for autocorrelated residuals
(estimators.recursive.least_squares), but not for the bias.

Source: Griese et al., (6) and (7), with signs and solution corrected and every signal filtered; Isermann and Muenchhof,
Identification of Dynamic Systems, section 15.1.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from upright.estimators.contract import Estimate, EstimationError, ParameterEstimate, Status
from upright.estimators.data.segments import DataError, segments
from upright.estimators.fit.result import correlation, refused, required_std
from upright.estimators.methods.balance import Balance, Pieces, Signals, channel, channel_signals, evaluator, split
from upright.estimators.numbers import about
from upright.estimators.recursive.least_squares import RecursiveLeastSquares
from upright.estimators.stopwatch import stopwatch
from upright.models.model import Model
from upright.models.parts import Parameter
from upright.models.segment import Segment
from upright.telemetry.recording import Recording

Array = NDArray[np.float64]

METHOD = "least_squares"
BANDWIDTH = 2.0 * np.pi * 5.0
"""rad/s, at most a twentieth of the sampling rate: above the excitation of vehicles, below most of the noise."""
WIDE = 10.0
"""Bandwidth of the filter that differentiates a position, relative to that of the regression."""
ROWS_A_PERIOD = 10
CORRELATION_TIME = 4.0
"""Longest correlation of a residual, s: that of the roll filter's corrections."""
REQUIRED_SHARE = 0.1
"""RMS by which a parameter's own term has to vary independently of the other terms, relative to the joint's force
scale."""
NOISE = 3.0
"""Standard deviations by which noise may take a parameter beyond its bound."""
FEWEST = 5
"""Fewest rows per parameter."""


@dataclass(frozen=True, slots=True)
class Rows:
    """The filtered balance of one segment, n rows: known (n,), regressors (n, p), anchored terms (n, a)."""

    known: Array
    regressors: Array
    anchored: Array


def least_squares(
    model: Model | str,
    recordings: Sequence[Recording],
    *,
    estimate: Iterable[str] | None = None,
    support: float | None = None,
    bandwidth: float | None = None,
    joint: str = "",
) -> Estimate:
    """The parameters of the balance at `joint` (by default the first) that `estimate`, or by default the model, names.

    `bandwidth`: rad/s of the filter (BANDWIDTH); `support`: rad, the vehicle is free at a smaller roll angle. Data that
    cannot be used give an Estimate without values that says why. Raises EstimationError if the balance is not linear in
    the estimated parameters, ModelError for an unknown name.
    """
    began = stopwatch()
    balance = split(model, joint, estimate)
    try:
        data = segments(balance.model, recordings, support=support)
    except DataError as error:
        return refused(balance.model, METHOD, error, stopwatch() - began)
    bandwidth = checked_bandwidth(bandwidth, data)
    rows = balance_rows(balance, data, bandwidth)
    return regression(METHOD, balance, data, rows, bandwidth, began)


def checked_bandwidth(bandwidth: float | None, data: Sequence[Segment]) -> float:
    """Bandwidth of the filter of the regression, rad/s; the default depends on the sampling rate. Raises
    EstimationError."""
    if bandwidth is None:
        spacing = float(np.median(np.concatenate([np.diff(segment.time) for segment in data])))
        return min(BANDWIDTH, 2.0 * np.pi / (20.0 * spacing))
    if not 0.0 < bandwidth < np.inf:
        raise EstimationError("bandwidth", f"{bandwidth:g} rad/s is invalid", remedy="use one above 0.")
    return bandwidth


def balance_rows(balance: Balance, data: Sequence[Segment], bandwidth: float, order: int = 2) -> list[Rows]:
    """The rows of each segment, filtered as in the paper (7); ROWS_A_PERIOD per period of `bandwidth` rad/s."""
    first, late = 1 + len(balance.free), 1 + len(balance.names)
    evaluate = evaluator((balance.known, *balance.regressors, *balance.shifted, *(e for *_, e in balance.anchored)))
    found = []
    for segment in data:
        signals = channel_signals(balance, segment)
        if balance.position:
            tenth = 2.0 * np.pi / (10.0 * float(np.median(np.diff(segment.time))))  # of the sampling rate
            signals = widely_filtered(signals, balance.position, max(bandwidth, min(WIDE * bandwidth, tenth)))
        if len(signals.time) < 2:
            continue
        terms = evaluate(signals)
        start = terms.left[0].copy()
        start[:first] = start[late:] = 0.0  # a jump of a derivative at the start is not motion
        smooth = filtered(Pieces(terms.time, terms.left - start, terms.right - start), bandwidth, order, 2)
        stride = 2.0 * np.pi / (bandwidth * ROWS_A_PERIOD)
        wanted = np.arange(terms.time[0] + stride, terms.time[-1], stride)
        at = np.unique(np.searchsorted(terms.time, wanted))
        regressors = np.concatenate((smooth[0][at, 1:first], smooth[1][at, first:late]), axis=1)
        found.append(Rows(smooth[0][at, 0], regressors, smooth[0][at, late:]))
    return found


def regression(
    method: str,
    balance: Balance,
    data: Sequence[Segment],
    rows: Sequence[Rows],
    bandwidth: float,
    began: float,
    instruments: Sequence[Array] = (),
) -> Estimate:
    """Solves `rows`, by two-stage least squares if there are `instruments` (n, m) for each segment; returns the
    Estimate."""
    count, size = sum(len(each.known) for each in rows), len(balance.names)
    span = sum(segment.duration for segment in data)
    if count < FEWEST * size:
        what = f"{span:.2f} s of free motion give {count} independent samples, {FEWEST * size} are needed"
        error = DataError(Status.TOO_FEW_SAMPLES, "recording", what, remedy="record for longer.")
        return refused(balance.model, method, error, stopwatch() - began)
    lags = int(min(CORRELATION_TIME, span / 5.0) * bandwidth * ROWS_A_PERIOD / (2.0 * np.pi))
    tools = instruments or [np.zeros((len(part.known), 0)) for part in rows]
    solver = RecursiveLeastSquares(size, instruments=tools[0].shape[1], lags=lags)
    for part, own in zip(rows, tools, strict=True):
        solver.interrupt()
        for known, regressors, tool in zip(part.known, part.regressors, own, strict=True):
            solver.update(known, regressors, tool)
    solution = solver.solve()
    used = np.concatenate([each.regressors for each in rows])
    if instruments:
        stacked = np.concatenate(instruments)
        used = stacked @ np.linalg.lstsq(stacked, used, rcond=None)[0]
    moved = solution.movement > 0.0
    covariance = np.where(np.outer(moved, moved), solution.covariance, 0.0)
    whole = covariance + _of_anchors(balance, rows, used, moved, solution.values)
    found = {}
    for place, name in enumerate(balance.names):
        start = balance.model.parameter(name).value if name in balance.shifts else 0.0
        value = start + float(solution.values[place])
        found[name] = _parameter(balance, place, value, covariance, whole, solution.movement, used)
    return assembled(method, balance, balance.names, found, whole, sum(map(len, data)), span, began)


def assembled(
    method: str,
    balance: Balance,
    names: Sequence[str],
    found: dict[str, ParameterEstimate],
    covariance: Array,
    samples: int,
    span: float,
    began: float,
    neglected: Mapping[str, str] | None = None,
) -> Estimate:
    """The Estimate of all estimated parameters. `covariance` (p, p) is that of `names`. `neglected` parameters are
    reported with their reason and do not count as failed."""
    neglected = neglected or {}
    for name in (*balance.absent, *neglected):
        reason = neglected.get(name, f"it does not occur in the balance of joint {balance.joint.name}")
        unit = balance.model.parameter(name).unit
        found[name] = ParameterEstimate(None, None, unit, Status.UNIDENTIFIABLE, 0.0, reason)
    estimated = [p for p in balance.model.parameters if p.estimated]
    order = [p.name for p in estimated]
    failed = next((found[name] for name in order if not found[name].identifiable and name not in neglected), None)
    pairs = np.full((len(order), len(order)), np.nan)
    identified = [place for place, name in enumerate(names) if found[name].identifiable]
    places = [order.index(names[place]) for place in identified]
    pairs[np.ix_(places, places)] = correlation(covariance[np.ix_(identified, identified)])
    hit = {p.name for p in estimated if found[p.name].value in (p.lower, p.upper)}
    hit |= {name for name in order if found[name].status is Status.AT_BOUND}
    return Estimate(
        method=method,
        parameters={name: found[name] for name in order},
        status=failed.status if failed else Status.OK,
        reason=failed.reason if failed else "",
        samples=samples,
        span=span,
        correlation=pairs,
        bounds_hit=tuple(name for name in order if name in hit),
        seconds=stopwatch() - began,
    )


def _of_anchors(balance: Balance, rows: Sequence[Rows], used: Array, moved: NDArray[np.bool_], values: Array) -> Array:
    """Contribution (p, p) of the parameters that are held at inexact values to the covariance."""
    change = np.zeros((len(used), len(balance.anchors)))
    stacked = np.concatenate([each.anchored for each in rows])
    for column, (anchor, place, _) in enumerate(balance.anchored):
        change[:, anchor] += stacked[:, column] * (values[place] if place >= 0 else 1.0)
    shift = np.zeros((len(moved), len(balance.anchors)))
    scale = np.sqrt(np.mean(used[:, moved] ** 2, axis=0))
    shift[moved] = np.linalg.lstsq(used[:, moved] / scale, -change, rcond=None)[0] / scale[:, None]
    shift *= [balance.model.parameter(name).std for name in balance.anchors]
    return shift @ shift.T


def _parameter(
    balance: Balance, place: int, value: float, covariance: Array, whole: Array, movement: Array, used: Array
) -> ParameterEstimate:
    """The estimate of one parameter; `covariance` is that of the data alone, `whole` includes that of the anchors."""
    parameter = balance.model.parameter(balance.names[place])
    variance = float(covariance[place, place])
    required, std = required_std(parameter), float(np.sqrt(variance)) if 0.0 <= variance < np.inf else np.inf
    own = movement[place] * size_of(parameter) / (REQUIRED_SHARE * balance.joint.force_scale)
    if parameter.name in balance.shifts and own > 0.0:  # noise cannot imitate its regressor
        own = required / max(std, 1e-300)
    coverage = 100.0 * min(1.0, own)

    def unknown(status: Status, reason: str) -> ParameterEstimate:
        return ParameterEstimate(None, None, parameter.unit, status, coverage, reason)

    reason, partner = "", _partner(used, place)
    if movement[place] == 0.0 or (coverage < 100.0 and parameter.name not in balance.shifts):
        reason = f"the term of {parameter.name} varies by {coverage:.0f} % of what is needed"
    elif std == np.inf:
        reason = f"the error of {parameter.name} cannot be estimated from {len(used)} samples: record for longer"
        return unknown(Status.TOO_FEW_SAMPLES, reason)
    elif std > required:
        reached, wanted = (f"± {about(each, parameter.unit)}" for each in (std, required))
        reason = f"the record determines {parameter.name} to {reached}, {wanted} is required"
    if reason and partner is not None:
        together = f"its term is correlated with that of {balance.names[partner]}; hold one of them"
        return unknown(Status.UNIDENTIFIABLE, f"{reason}: {together}")
    if reason:
        return unknown(
            Status.TOO_LITTLE_EXCITATION, f"{reason}: excite it more strongly, over a wider band or for longer"
        )
    bounded = float(np.clip(value, parameter.lower, parameter.upper))
    if abs(bounded - value) > NOISE * std:
        reason = f"the estimate of {parameter.name} is {value:.4g} {parameter.unit}, which is impossible"
        return unknown(Status.AT_BOUND, f"{reason}: check signs and units")
    return ParameterEstimate(bounded, float(np.sqrt(whole[place, place])), parameter.unit, Status.OK, coverage)


def size_of(parameter: Parameter) -> float:
    """A typical magnitude of the parameter itself."""
    return max(abs(parameter.value), parameter.scale, parameter.std) or 1.0


def _partner(used: Array, place: int) -> int | None:
    """Index of the regressor that contributes most to a combination that nearly equals the one at `place`; None if no
    combination does."""
    scale = np.sqrt(np.mean(used**2, axis=0))
    if scale[place] == 0.0 or used.shape[1] == 1:
        return None
    scaled = used / np.where(scale > 0.0, scale, 1.0)
    others = np.delete(scaled, place, axis=1)
    weights = np.linalg.lstsq(others, scaled[:, place], rcond=None)[0]
    if np.mean((scaled[:, place] - others @ weights) ** 2) > 0.1:
        return None
    return int(np.delete(np.arange(used.shape[1]), place)[np.argmax(np.abs(weights))])


def widely_filtered(signals: Signals, position: str, bandwidth: float) -> Signals:
    """Every channel through one wide low-pass, which also gives the derivatives of the measured `position`."""
    names = list(signals.left)
    ends = [np.stack([end[name] for name in names], axis=1) for end in (signals.left, signals.right)]
    smooth = filtered(Pieces(signals.time, *ends), bandwidth, 4, 3)
    ready = int(np.searchsorted(signals.time, signals.time[0] + 10.0 / bandwidth))  # the transient has decayed
    drawn = {name: smooth[0][ready:, place] for place, name in enumerate(names)}
    for derivative in (1, 2):
        drawn[channel(position, derivative).name] = smooth[derivative][ready:, names.index(channel(position).name)]
    drawn["time"] = signals.time[ready:]
    return Signals(signals.time[ready:], {n: v[:-1] for n, v in drawn.items()}, {n: v[1:] for n, v in drawn.items()})


def filtered(pieces: Pieces, bandwidth: float, order: int, derivatives: int) -> Array:
    """`pieces` through a Butterworth low-pass from rest, and derivatives up to order - 1: (derivatives, m + 1, terms).

    As estimators.data.state_variable_filter, for a whole segment at once: exact for piecewise linear signals, at any
    spacing.
    """
    angles = np.pi * (2 * np.arange(order) + order + 1) / (2 * order)
    poles = bandwidth * np.exp(1j * angles)
    residues = np.array([bandwidth**order / np.prod(pole - np.delete(poles, i)) for i, pole in enumerate(poles)])
    upper = poles.imag > -1e-9 * bandwidth
    pairs = np.where(poles[upper].imag > 1e-9 * bandwidth, 2.0, 1.0)
    poles, residues = poles[upper], pairs * residues[upper]
    exponent = np.diff(pieces.time)[:, None] * poles
    growth = np.expm1(exponent)
    held, ramp = growth / poles, (growth - exponent) / (poles * exponent)
    modes = np.zeros((len(pieces.time), len(poles), pieces.left.shape[1]), dtype=np.complex128)
    modes[1:] = held[:, :, None] * pieces.left[:, None] + ramp[:, :, None] * (pieces.right - pieces.left)[:, None]
    decay = (growth + 1.0)[:, :, None]
    for step in range(1, len(modes)):
        modes[step] += decay[step - 1] * modes[step - 1]
    return np.asarray(np.einsum("dp,npc->dnc", residues * poles ** np.arange(derivatives)[:, None], modes).real)
