"""The noise of a model in innovations form: from process and sensor noise to the steady-state Kalman gain.

    x+ = f(x + K e, u),   e = y - h(x, u),   A K = (A P C' + N) S^-1,   S = C P C' + R

P is the solution of the discrete Riccati equation. Process noise is white, on the states that have one. Sensor noise is
white on every output, and integrated in states that a filter computes from a sensor (N is their cross-covariance). The
gain depends on the ratios of the noises only, so the sensor noise of the last output is the unit of all others. Their
logarithms are estimated together with the parameters. With this gain the predictor of an unstable plant is stable,
which is why the prediction error is the sound choice there.
Source: Ljung, "System identification", 2nd ed., sections 4.3 and 7.4; the Riccati equation by structure-preserving
doubling: Chu et al., International Journal of Control 77 (2004) 767-788.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from upright.estimators.contract import EstimationError
from upright.estimators.fit.problem import Problem, at_rest, linearise, typical_motion
from upright.estimators.fit.stationary import DOUBLINGS, stationary, stationary_all
from upright.models.parts import Output, State
from upright.models.segment import Segment

Array = NDArray[np.float64]

SENSOR_SPREAD = 1.0
"""Standard deviation, in natural logarithms, of the prior on a sensor's noise: a factor of 2.7."""
WIDEST = 6.0
"""Largest natural logarithm of the ratio of a noise to the model's value, a factor of 400, unless SPREADS allows
more."""
SPREADS = 3.0
"""The same for a noise that is hardly known, in multiples of its spread."""
STEP = 1e-4
"""Step of an argument of the gain for a numerical derivative, relative to its typical magnitude."""
SETTLED = 1e-8
"""Largest relative change of a covariance by the last doubling."""
RESOLUTION = 1e-5
"""Share of an output's standard deviation that is added as noise if the output is identical to another, as with both
wheels of a vehicle that is symmetric to the last bit."""
FLOOR = 1e-6
"""Process noise that every state has, relative to the process noise of the model: keeps every mode observable."""


@dataclass(frozen=True, slots=True)
class SteadyState:
    """A filter in its steady state, and derivatives with respect to p parameters and the q logarithms of the noise.

    `gain` (nx, ny) of the filter, `predictor` F = A - A K C (nx, nx), and `sample` C' S^-1 C (nx, nx), the information
    of a sample on the state before it. `slopes` (nx * ny, p + q), `predictor_slopes` and `sample_slopes`
    (p + q, nx, nx) are their derivatives.
    """

    gain: Array
    slopes: Array
    predictor: Array
    predictor_slopes: Array
    sample: Array
    sample_slopes: Array

    def start_information(self, unknowns: Sequence[int] = ()) -> tuple[Array, Array]:
        """Information of all samples on the initial state, an inverse covariance D (nx, nx), and its derivatives
        (m, nx, nx) with respect to `unknowns`, m of the p + q.

        D = F' D F + C' S^-1 C. What the samples determine without bound counts as zero, with derivatives of zero.
        """
        turned, places = self.predictor.T, list(unknowns)
        found = stationary_all(turned, self.sample[None])[0]
        if not np.isfinite(found).all():
            return np.zeros_like(found), np.zeros((len(places), *found.shape))
        half = _turned(self.predictor_slopes[places]) @ found @ self.predictor
        moved = half + _turned(half) + self.sample_slopes[places]
        slopes = stationary_all(turned, moved)
        return found, np.where(np.isfinite(slopes), slopes, 0.0)


@dataclass(frozen=True, slots=True)
class NoiseModel:
    """The noises of a problem. `process` (nx,), unit/sqrt(s), and `sensor` (ny,) are where the estimation starts.

    The logarithms (q,) are those of the states `noisy` and of the outputs `loud`, whose noise is estimated; the output
    that is the unit is not among them. Outputs that are identical in every sample, as of both wheels of a vehicle that
    is symmetric to the last bit, share one noise: `process_place` and `sensor_place` are the indices of the logarithms
    of `noisy` and `loud`.
    """

    problem: Problem
    spacing: float
    process: Array
    sensor: Array
    noisy: tuple[int, ...]
    loud: tuple[int, ...]
    process_place: tuple[int, ...]
    sensor_place: tuple[int, ...]
    spread: Array
    """Prior standard deviation of each logarithm, (q,)."""
    integrated: Array
    """Which output's noise is integrated in which state, (nx, ny) of 0 and 1."""
    rest: Segment
    """Inputs at which the model is linearised."""
    added: Array
    """Noise (ny,) that is added to each output: RESOLUTION if it is identical to an earlier one, otherwise 0."""
    motion: Array
    """State (nx,) at which the model is linearised."""

    @classmethod
    def of(cls, problem: Problem) -> NoiseModel:
        """The noises that the model states."""
        states, outputs = problem.model.states, problem.model.outputs
        process = np.array([state.process_noise for state in states])
        spacing = float(np.median(np.diff(problem.segments[0].time)))
        same = _identical(problem)
        noisy = [place for place, state in enumerate(states) if state.process_noise > 0.0 and not state.noise_known]
        unit = _unit_of(states, outputs)
        # Outputs that are identical to the unit share its noise.
        loud = [
            place
            for place, output in enumerate(outputs)
            if not output.noise_known
            and (unit is None or same.get(output.name, output.name) != same.get(unit.name, unit.name))
        ]
        process_place = _places([states[place].name for place in noisy], same, first=0)
        sensor_place = _places([outputs[place].name for place in loud], same, first=len(set(process_place)))
        spread = np.full(len({*process_place, *sensor_place}), SENSOR_SPREAD)
        spread[list(process_place)] = [states[place].noise_spread for place in noisy]
        return cls(
            problem=problem,
            spacing=spacing,
            process=process,
            sensor=np.array([output.noise for output in outputs]),
            noisy=tuple(noisy),
            loud=tuple(loud),
            process_place=process_place,
            sensor_place=sensor_place,
            spread=spread,
            integrated=np.array([[float(state.noise_of == output.name) for output in outputs] for state in states]),
            rest=at_rest(problem.kernel, problem.segments, spacing),
            added=_added(problem, same),
            motion=typical_motion(problem.model, problem.segments),
        )

    @property
    def size(self) -> int:
        """Number of logarithms, q."""
        return len(self.spread)

    @property
    def widest(self) -> Array:
        """Largest magnitude of each logarithm, (q,)."""
        return np.maximum(WIDEST, SPREADS * self.spread)

    def logarithm_of(self, state: str) -> int | None:
        """Index of the logarithm of the process noise of `state`; None if the noise is known or there is none."""
        names = [self.problem.model.states[place].name for place in self.noisy]
        return self.process_place[names.index(state)] if state in names else None

    def gain(self, values: Array, logarithms: Array) -> Array | None:
        """The filter gain (nx, ny) at parameter values (np,); None if no filter is stable."""
        steady = _steady(*self.covariances(values, logarithms))
        return None if steady is None else steady.gain

    def units(self, values: Array, logarithms: Array, covariance: Array) -> Array:
        """Ratio (n, nx) of the actual noise that drives each state to its value in this model, if the innovations have
        the `covariance` (ny, ny); for parameter values (n, np) and logarithms (n, q). 1 if it is not identifiable.

        The gain depends on the ratios of the noises alone. The common scale of a state follows from the RMS of its
        corrections k e over that expected with these noises: the square root of k S k' over its expectation, with k the
        state's row of the gain.
        """
        found = np.ones((len(logarithms), len(self.process)))
        for unit, system in zip(found, zip(*self._systems(values, logarithms), strict=True), strict=True):
            if (steady := _steady(*system)) is None:
                continue
            moved, expected = (
                np.einsum("ij,jk,ik->i", steady.gain, each, steady.gain) for each in (covariance, steady.innovation)
            )
            corrected = expected > 0.0
            unit[corrected] = np.sqrt(moved[corrected] / expected[corrected])
        return found

    def innovation(self, values: Array, logarithms: Array, gain: Array | None) -> Array | None:
        """Covariance (ny, ny) of the innovations of a predictor with this `gain` (nx, ny), at parameter values (np,)
        and logarithms (q,) of the noise; None if the predictor is not stable."""
        if gain is None:
            return None
        A, C, process, sensor, across = self.covariances(values, logarithms)
        ahead = A @ gain
        driven = process + ahead @ sensor @ ahead.T - across @ ahead.T - ahead @ across.T
        try:
            return np.asarray(C @ stationary(A - ahead @ C, driven) @ C.T + sensor)
        except EstimationError:
            return None

    def covariances(self, values: Array, logarithms: Array) -> tuple[Array, Array, Array, Array, Array]:
        """The linear system of the gain: A (nx, nx), C (ny, nx) and, per sample, the covariances of the process noise
        (nx, nx) and of the sensor noise (ny, ny), and their cross-covariance (nx, ny)."""
        A, C, process, sensor, across = self._systems(values[None], logarithms[None])
        return A[0], C[0], process[0], sensor[0], across[0]

    def steady_state(self, values: Array, logarithms: Array, free: Sequence[int], scale: Array) -> SteadyState | None:
        """The filter at parameter values (np,) and logarithms (q,), with its derivatives with respect to the parameters
        `free`, of typical magnitudes `scale` (p,), and to the logarithms; None if no filter is stable."""
        sizes = STEP * np.concatenate((scale, np.ones(self.size)))
        moves = np.repeat(np.diag(sizes), 2, axis=0)
        moves[1::2] *= -1.0
        # Parameters one by one, then all logarithms at the same values, where the linearised model is the same.
        many = np.repeat(values[None], 2 * len(free) + 1, axis=0)
        many[:-1, list(free)] += moves[: 2 * len(free), : len(free)]
        systems = self._systems(many, logarithms + np.concatenate((moves[:, len(free) :], np.zeros((1, self.size)))))
        steady = _steady(*(each[-1] for each in systems))
        if steady is None:
            return None
        rises = [(each[:-1:2] - each[1::2]) / (2.0 * sizes)[:, None, None] for each in systems]
        try:
            return steady.differentiated(*rises)
        except np.linalg.LinAlgError:  # at the stability limit the error of a filter does not decay
            return None

    def _systems(self, values: Array, logarithms: Array) -> tuple[Array, ...]:
        """Transition and output matrices, covariances of process and sensor noise and their cross-covariance, for each
        row of parameter values (m, np) and of logarithms (n, q); the last row of values is repeated if m < n."""
        transition, output = (
            np.concatenate((each, np.repeat(each[-1:], len(logarithms) - len(values), axis=0)))
            for each in linearise(self.problem.kernel, values, self.rest, self.motion, substeps=self.problem.substeps)
        )
        process = np.tile(self.process, (len(logarithms), 1))
        sensor = np.tile(self.sensor, (len(logarithms), 1))
        factors = np.exp(logarithms)
        process[:, list(self.noisy)] *= factors[:, list(self.process_place)]
        sensor[:, list(self.loud)] *= factors[:, list(self.sensor_place)]
        half = 0.5 * (np.eye(len(self.process)) + transition)
        # A filter integrates sensor noise by the trapezoidal rule: half acts at once, all from the next sample on.
        trapezoid = self.spacing * self.integrated * sensor[:, None, :]
        shown = np.eye(len(self.sensor)) * sensor[:, None, :] + 0.5 * output @ trapezoid
        floor = np.diag((FLOOR * np.maximum(self.process, np.min(self.sensor))) ** 2)
        with np.errstate(invalid="ignore", over="ignore"):  # no filter exists if the integration steps overflow
            smooth = half * (process * np.sqrt(self.spacing))[:, None, :]
            density = smooth @ _turned(smooth) + floor + trapezoid @ _turned(trapezoid)
        return transition, output, density, shown @ _turned(shown), trapezoid @ _turned(shown)


def _unit_of(states: Sequence[State], outputs: Sequence[Output]) -> Output | None:
    """The output whose noise is the unit of all others, since the gain depends on ratios of noises only.

    It is the last output whose noise is estimated and white, which that of a counted one is not. If there is none, it
    is the last output. None if the magnitude of a disturbance is stated, which is then the unit."""
    if any(each.correlation_time and each.noise_known and each.process_noise > 0.0 for each in states):
        return None
    noisy = [each for each in outputs if not (each.noise_known or each.counted)]
    return noisy[-1] if noisy else outputs[-1]


def _identical(problem: Problem) -> dict[str, str]:
    """Outputs that are identical to an earlier one in every sample: name to the name of that one, which maps to
    itself."""
    names = [output.name for output in problem.model.outputs]
    same: dict[str, str] = {}
    for place, name in enumerate(names):
        for earlier, other in enumerate(names[:place]):
            if all(np.array_equal(each.measured[:, place], each.measured[:, earlier]) for each in problem.segments):
                same[name] = same.setdefault(other, other)
                break
    return same


def _added(problem: Problem, same: dict[str, str]) -> Array:
    """`added` of NoiseModel."""
    added = np.zeros(len(problem.model.outputs))
    for place, output in enumerate(problem.model.outputs):
        if same.get(output.name, output.name) != output.name:
            measured = np.concatenate([each.measured[:, place] for each in problem.segments])
            added[place] = RESOLUTION * np.nanstd(measured)
    return added


def _places(names: Sequence[str], same: dict[str, str], *, first: int) -> tuple[int, ...]:
    """Numbers from `first` on for `names`, the same for those that are identical."""
    number: dict[str, int] = {}
    return tuple(number.setdefault(same.get(name, name), first + len(number)) for name in names)


@dataclass(frozen=True, slots=True)
class _Steady:
    """A steady-state filter: its system, covariances (nx, nx) of the state before a correction and (ny, ny) of the
    innovation, gain `ahead` (nx, ny) of the one-step prediction, and `gain` of the filter."""

    transition: Array
    output: Array
    covariance: Array
    innovation: Array
    ahead: Array
    gain: Array

    def differentiated(
        self, transition: Array, output: Array, process: Array, sensor: Array, across: Array
    ) -> SteadyState:
        """The filter with its derivatives, given m derivatives of its system.

        The covariance is minimal with respect to the gain, so its derivative is that with the gain held, from a
        Lyapunov equation.
        """
        A, C, P, L, S = self.transition, self.output, self.covariance, self.ahead, self.innovation
        closed = A - L @ C
        half = (transition - L @ output) @ P @ closed.T - across @ L.T
        moved = half + _turned(half) + process + L @ sensor @ L.T
        states = len(A)
        system = np.eye(states**2) - np.kron(closed, closed)
        spread = np.linalg.solve(system, moved.reshape(len(moved), states**2).T).T.reshape(moved.shape)
        seen = spread @ C.T + P @ _turned(output)
        innovation = output @ P @ C.T + C @ seen + sensor
        ahead = transition @ P @ C.T + A @ seen + across - L @ innovation
        ahead = _turned(np.linalg.solve(S, _turned(ahead)).astype(np.float64))
        gain = np.linalg.solve(A, ahead - transition @ self.gain)
        known = np.linalg.solve(S, C)
        half = _turned(output) @ known
        return SteadyState(
            gain=self.gain,
            slopes=np.ascontiguousarray(gain.reshape(len(gain), self.gain.size).T),
            predictor=closed,
            predictor_slopes=transition - ahead @ C - L @ output,
            sample=C.T @ known,
            sample_slopes=half + _turned(half) - known.T @ innovation @ known,
        )


def _steady(transition: Array, output: Array, process: Array, sensor: Array, across: Array) -> _Steady | None:
    """The filter whose gain K makes x + K (y - C x) the minimum-variance estimate; None if there is none.

    x+ = A x + w, y = C x + v with covariances process (nx, nx), sensor (ny, ny), across (nx, ny) = E w v'.
    """
    if not (np.isfinite(transition).all() and np.isfinite(process).all()):
        return None
    A, C, S, states = transition, output, across, len(transition)
    try:
        inner = np.linalg.solve(sensor, np.concatenate((C, S.T), axis=1))
        P = _doubled(A - S @ inner[:, :states], C.T @ inner[:, :states], process - S @ inner[:, states:])
        if P is None:
            return None
        innovation = C @ P @ C.T + sensor
        ahead = np.linalg.solve(innovation, C @ P @ A.T + S.T).astype(np.float64).T
        gain = np.linalg.solve(A, ahead).astype(np.float64)
    except np.linalg.LinAlgError:
        return None
    return _Steady(A, C, P, innovation, ahead, gain) if np.isfinite(gain).all() else None


def _turned(matrices: Array) -> Array:
    return np.swapaxes(matrices, -1, -2)


def _doubled(transition: Array, known: Array, process: Array) -> Array | None:
    """P = A P (I + G P)^-1 A' + Q by doubling, (nx, nx); None if it does not converge.

    Raises LinAlgError if a matrix is singular."""
    states = len(transition)
    unit = np.eye(states)
    A, G, H = transition.T, known, 0.5 * (process + process.T)
    with np.errstate(over="ignore", invalid="ignore"):  # on overflow there is no steady-state filter
        for _ in range(DOUBLINGS):
            ratio = np.linalg.solve(unit + G @ H, np.concatenate((A, G), axis=1))
            first, second = ratio[:, :states], ratio[:, states:]
            grown = H + A.T @ H @ first
            if not np.isfinite(grown).all():
                return None
            # Each state in its own unit: compared with a disturbance of 100 N m, an angle of 1e-5 rad would count as
            # converged too early.
            size = np.sqrt(np.maximum(grown.diagonal(), 0.0))
            # Convergence is quadratic, so the next doubling is exact.
            if (np.abs(grown - H) <= SETTLED * size[:, None] * size).all():
                return np.asarray(0.5 * (grown + grown.T))
            G, A, H = G + A @ second @ A.T, A @ first, grown
    return None
