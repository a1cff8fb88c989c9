"""Baselines that regress the missing torque on a library of terms (`terms`), as is usually tried first.

differentiate_sindy: the measured rate is differentiated, and sequentially thresholded least squares selects the terms
(Brunton, Proctor, Kutz, PNAS 113 (2016) 3932, as in PySINDy); the threshold is chosen by BIC.
smoother_stepwise: a Kalman filter with the missing torque as an additional state and a Rauch-Tung-Striebel smoother
give the torque, and terms are added one by one as long as an F test finds them significant (Draper, Smith, Applied
Regression Analysis, 3rd ed., chapter 15).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from filterpy.kalman import KalmanFilter
from numpy.typing import NDArray
from scipy.linalg import expm

from upright.estimators.data.segments import segments
from upright.estimators.tails import f_sf
from upright.models.effect import Effect
from upright.models.model import Model
from upright.models.segment import Segment
from upright.service.hidden_effects.methods.answers import Answer
from upright.service.hidden_effects.methods.terms import Term, evaluated, measured, regression, residual
from upright.telemetry.errors import UprightError
from upright.telemetry.recording import Recording

Array = NDArray[np.float64]

THRESHOLDS = (0.01, 0.02, 0.05, 0.1, 0.2, 0.5)
"""Shares of the unexplained acceleration below which a term is dropped."""
SIGNIFICANCE = 0.01
"""Significance level of the F test, divided by the number of terms."""
MOST_TERMS = 4
"""Maximum number of terms that are added; at most two effects are hidden."""
TORQUE_WALK = 3.0
"""Random walk of the missing torque in one second, in typical torques of the joint: it changes within 0.1 s."""


def differentiate_sindy(
    model: Model,
    recordings: Sequence[Recording],
    support: float,
    candidates: Sequence[str | Effect] | None = None,
) -> Answer:
    """Differentiate, then apply PySINDy. Raises UprightError if PySINDy is not installed."""
    try:
        from pysindy import STLSQ, SmoothedFiniteDifference
    except ImportError as error:
        remedy = "install it (pip install 'upright[bench]'), or name the other baselines with --baseline."
        raise UprightError("PySINDy is not installed.", remedy=remedy) from error
    segment = _longest(model, recordings, support)
    names = measured(model, segment)
    rate = np.asarray(names[model.joints[0].rate])
    acceleration = np.ravel(SmoothedFiniteDifference()(rate[:, None], segment.time))
    library = regression(model, names)
    target = residual(acceleration, library.nominal)
    columns = _scaled(np.column_stack([term.columns for term in library.terms]), library.nominal)
    owners = _owners(library.terms)
    target = target / max(float(np.std(target)), 1e-300)
    best, chosen = len(target) * float(np.log(np.mean(target**2))), np.zeros(columns.shape[1])
    for threshold in THRESHOLDS:
        coefficients = np.ravel(STLSQ(threshold=threshold, alpha=1e-6).fit(columns, target[:, None]).coef_)
        rest = float(np.mean((target - columns @ coefficients) ** 2))
        score = len(target) * float(np.log(rest)) + np.count_nonzero(coefficients) * float(np.log(len(target)))
        if score < best:
            best, chosen = score, coefficients
    order = np.argsort(-np.abs(chosen))
    return Answer.naming(*dict.fromkeys(owners[place] for place in order if chosen[place] != 0.0))


def smoother_stepwise(
    model: Model,
    recordings: Sequence[Recording],
    support: float,
    candidates: Sequence[str | Effect] | None = None,
) -> Answer:
    """Smooth, then apply stepwise regression."""
    segment = _longest(model, recordings, support)
    smoothed, torque, stride = _smoothed(model, segment)
    library = regression(model, {**measured(model, segment), **smoothed})
    # Neighbouring samples of a smoothed torque are correlated: one in `stride` is kept.
    nominal = library.nominal[::stride]
    left = residual(torque[::stride], nominal)
    terms = [(term.effect, _scaled(term.columns[::stride], nominal)) for term in library.terms]
    found: list[str] = []
    while len(found) < MOST_TERMS:
        tests = [_f_test(left, columns, used=nominal.shape[1] + len(found)) for _, columns in terms]
        best = int(np.argmin(tests))
        if tests[best] >= SIGNIFICANCE / len(terms):
            break
        effect, columns = terms[best]
        found.append(effect)
        left = residual(left, columns)
        terms = [(name, residual(each, columns)) for name, each in terms if name != effect]
    return Answer.naming(*found)


def _longest(model: Model, recordings: Sequence[Recording], support: float) -> Segment:
    return max(segments(model, recordings, support=support), key=len)


def _owners(terms: Sequence[Term]) -> list[str]:
    return [term.effect for term in terms for _ in range(term.columns.shape[1])]


def _scaled(columns: Array, nominal: Array) -> Array:
    """Columns (n, m) without the part explained by `nominal`, scaled to unit RMS; zero if it explains all of them."""
    before = np.linalg.norm(columns, axis=0)
    rest = residual(columns, nominal)
    size = np.linalg.norm(rest, axis=0)
    unexplained = size > 1e-6 * np.maximum(before, 1e-300)
    return np.asarray(np.where(unexplained, rest, 0.0) / np.where(unexplained, size, 1.0) * np.sqrt(len(columns)))


def _f_test(left: Array, columns: Array, used: int) -> float:
    """p-value: probability that random columns explain as much of `left` (n,)."""
    after = residual(left, columns)
    count = int(np.linalg.matrix_rank(columns))
    free = len(left) - used - count
    if count == 0 or free <= 0:
        return 1.0
    ratio = (float(left @ left) - float(after @ after)) / count / (float(after @ after) / free)
    return float(f_sf(ratio, count, free))


def _smoothed(model: Model, segment: Segment) -> tuple[dict[str, Array], Array, int]:
    """Smoothed coordinate and rate by name, the missing torque (n,), and the stride at which its samples are
    independent."""
    joint = model.joints[0]
    names = measured(model, segment)
    inertia = float(evaluated(joint.inertia, model.values))
    coordinate = np.asarray(names[joint.coordinate])
    step = float(np.median(np.diff(segment.time)))
    # The stiffness is that of gravity along the coordinate; the rest of the load is known from measurements.
    stiffness = _slope(model, names)
    known = evaluated(joint.load, names) - stiffness * coordinate
    system = np.array([[0.0, 1.0, 0.0], [stiffness / inertia, 0.0, 1.0 / inertia], [0.0, 0.0, 0.0]])
    noise = {output.name: output.noise for output in model.outputs}
    sensors = np.array([noise[joint.coordinate], noise[joint.rate]])
    walk = TORQUE_WALK * joint.force_scale
    kalman = KalmanFilter(dim_x=3, dim_z=2, dim_u=1)
    kalman.x = np.array([coordinate[0], np.asarray(names[joint.rate])[0], 0.0])
    kalman.P = np.diag([*sensors**2, (10.0 * joint.force_scale) ** 2])
    kalman.F = expm(system * step)
    kalman.B = np.array([[0.5 * step**2 / inertia], [step / inertia], [0.0]])
    kalman.H = np.eye(2, 3)
    kalman.R = np.diag(sensors**2)
    kalman.Q = np.diag([0.0, 0.0, walk**2 * step])
    states = [kalman.x]
    covariances = [kalman.P]
    readings = np.column_stack((coordinate, np.asarray(names[joint.rate])))
    held = 0.5 * (known[1:] + known[:-1])
    for row in range(1, len(readings)):
        kalman.predict(u=held[row - 1 : row])
        kalman.update(readings[row])
        states.append(kalman.x)
        covariances.append(kalman.P)
    smooth = _backwards(kalman, np.array(states), np.array(covariances), held)
    # Bandwidth of the torque's estimate: where its random walk and the rate's noise have equal weight.
    bandwidth = (walk / (inertia * sensors[1] * np.sqrt(step))) ** 0.5
    stride = max(1, round(np.pi / bandwidth / step))
    return {joint.coordinate: smooth[:, 0], joint.rate: smooth[:, 1]}, smooth[:, 2], stride


def _backwards(kalman: KalmanFilter, states: Array, covariances: Array, held: Array) -> Array:
    """Rauch-Tung-Striebel smoother, (n, 3); filterpy's version does not support an input."""
    smooth = states.copy()
    for row in range(len(states) - 2, -1, -1):
        ahead = kalman.F @ covariances[row] @ kalman.F.T + kalman.Q
        back = np.linalg.solve(ahead, kalman.F @ covariances[row]).T
        smooth[row] += back @ (smooth[row + 1] - kalman.F @ states[row] - kalman.B[:, 0] * held[row])
    return smooth


def _slope(model: Model, names: dict[str, Array | float]) -> float:
    """The load's derivative with respect to the coordinate."""
    joint = model.joints[0]
    moved = {**names, joint.coordinate: np.asarray(names[joint.coordinate]) + joint.coordinate_scale}
    change = evaluated(joint.load, moved) - evaluated(joint.load, names)
    return float(np.mean(change)) / joint.coordinate_scale
