"""The noise of a model in innovations form: from process and sensor noise to the steady Kalman gain.

    x+ = f(x + K e, u),   e = y - h(x, u),   A K = (A P C' + N) S^-1,   S = C P C' + R

P is from the discrete Riccati equation. Process noise is white on the states that name one. Sensor noise is white on
every output, and integrated in states that are what a filter makes of a sensor (N is their common part). The gain
depends on ratios only, so the last output's sensor noise is the unit that all others are told in, as logarithms: these
are estimated along with the parameters. The gain makes a stable predictor of an unstable plant, which is why the
prediction error is the sound choice there.
Source: Ljung, "System identification", 2nd ed., sections 4.3 and 7.4; the Riccati equation by structure-preserving
doubling: Chu et al., International Journal of Control 77 (2004) 767-788.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from estimators.contract import EstimationError
from estimators.fit.problem import Problem, at_rest, linearise, typical_motion
from estimators.fit.stationary import DOUBLINGS, in_the_long_run, stationary
from models.parts import Output, State
from models.segment import Segment

Array = NDArray[np.float64]

SENSOR_SPREAD = 1.0
"""Standard deviation, in natural logarithms, of the prior on a sensor's noise: a factor of 2.7."""
WIDEST = 6.0
"""Natural logarithm by which a noise may differ from what the model says: a factor of 400, or this, in SPREADS."""
SPREADS = 3.0
"""Times its spread by which a noise that is hardly known may differ."""
STEP = 1e-4
"""Share of its typical size by which an argument of the gain is moved for a derivative."""
SETTLED = 1e-8
"""Share of its size by which the last doubling may change a covariance."""
FLOOR = 1e-6
"""Process noise that every state has, in units of the process noise the model states: keeps every mode observable."""


@dataclass(frozen=True, slots=True)
class NoiseModel:
    """The noises of a problem. `process` (nx,), unit/sqrt(s), and `sensor` (ny,) are where the estimation starts.

    `noisy` are the states and `loud` the outputs but the last whose noise is not known: the logarithms, (q,), are
    theirs. What reads exactly alike in every row, as both wheels of a vehicle that is symmetric to the last bit, has
    one noise: `process_place` and `sensor_place` say which logarithm each of `noisy` and `loud` goes by.
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
    """Standard deviation of each logarithm before a record is seen, (q,)."""
    integrated: Array
    """Which output's noise is integrated in which state, (nx, ny) of 0 and 1."""
    rest: Segment
    copies: tuple[int, ...]
    """Outputs that read exactly as an earlier one."""
    motion: Array
    """Inputs, and state (nx,), at which the model is taken as linear."""

    @classmethod
    def of(cls, problem: Problem) -> NoiseModel:
        """What the model says of its noise."""
        states, outputs = problem.model.states, problem.model.outputs
        process = np.array([state.process_noise for state in states])
        spacing = float(np.median(np.diff(problem.segments[0].time)))
        same = _alike(problem)
        noisy = [place for place, state in enumerate(states) if state.process_noise > 0.0 and not state.noise_known]
        unit = _unit_of(states, outputs)
        # What reads as the output that is the unit is in it, too.
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
            copies=tuple(place for place, each in enumerate(outputs) if same.get(each.name, each.name) != each.name),
            motion=typical_motion(problem.model, problem.segments),
        )

    @property
    def size(self) -> int:
        """How many logarithms there are, q."""
        return len(self.spread)

    @property
    def widest(self) -> Array:
        """The most that a logarithm may be, to either side, (q,)."""
        return np.maximum(WIDEST, SPREADS * self.spread)

    def logarithm_of(self, state: str) -> int | None:
        """Place of the logarithm of the process noise of `state`; None where it is known, or none."""
        names = [self.problem.model.states[place].name for place in self.noisy]
        return self.process_place[names.index(state)] if state in names else None

    def gain(self, values: Array, logarithms: Array) -> Array | None:
        """The filter gain (nx, ny) at parameter values (np,); None where there is no stable one."""
        steady = _steady(*(each[None] for each in self.covariances(values, logarithms)))
        return steady.gain[0] if steady.there[0] else None

    def units(self, values: Array, logarithms: Array, covariance: Array) -> Array:
        """By how much the noise that drives each state is larger than it is told here, (n, nx), where the innovations
        have the `covariance` (ny, ny); for parameter values (n, np) and logarithms (n, q), 1 where nothing tells.

        The gain depends on the ratios of the noises alone. A state's unit is by how much more its corrections k e move
        than they would by these noises: the root of k S k' over its expectation, with k its row of the gain.
        """
        steady = _steady(*self._systems(values, logarithms))
        moved = np.einsum("nij,jk,nik->ni", steady.gain, covariance, steady.gain)
        expected = np.einsum("nij,njk,nik->ni", steady.gain, steady.innovation, steady.gain)
        told = expected > 0.0
        return np.where(told, np.sqrt(moved / np.where(told, expected, 1.0)), 1.0)

    def innovation(self, values: Array, logarithms: Array, gain: Array | None) -> Array | None:
        """Covariance (ny, ny) of the innovations of a predictor with that `gain` (nx, ny), at parameter values (np,)
        and logarithms (q,) of the noise; None where it has none."""
        if gain is None:
            return None
        A, C, process, sensor, across = self.covariances(values, logarithms)
        ahead = A @ gain
        driven = process + ahead @ sensor @ ahead.T - across @ ahead.T - ahead @ across.T
        try:
            return np.asarray(C @ stationary(A - ahead @ C, driven) @ C.T + sensor)
        except EstimationError:
            return None

    def of_start(self, values: Array, logarithms: Array) -> Array:
        """What all rows tell of the state that they begin with, an inverse covariance (n, nx, nx), for parameter values
        (n, np) and logarithms (n, q): the sum over the rows of F'^k C' S^-1 C F^k with the predictor F = A - A K C.
        Zero where no filter is stable."""
        return _steady(*self._systems(values, logarithms)).of_start

    def covariances(self, values: Array, logarithms: Array) -> tuple[Array, Array, Array, Array, Array]:
        """The linear system that the gain is for: A (nx, nx), C (ny, nx) and the covariances of a row's process noise
        (nx, nx), sensor noise (ny, ny) and of both together (nx, ny)."""
        A, C, process, sensor, across = self._systems(values[None], logarithms[None])
        return A[0], C[0], process[0], sensor[0], across[0]

    def slopes(self, values: Array, logarithms: Array, free: Sequence[int], scale: Array) -> Array | None:
        """The gain's derivatives by the parameters `free`, of typical sizes `scale` (p,), and the logarithms,
        (nx * ny, p + q)."""
        found = self.gain_and_slopes(values, logarithms, free, scale)
        return None if found is None else found[1]

    def gain_and_slopes(
        self, values: Array, logarithms: Array, free: Sequence[int], scale: Array
    ) -> tuple[Array, Array] | None:
        """Both at once; None where no filter is stable."""
        sizes = STEP * np.concatenate((scale, np.ones(self.size)))
        moves = np.repeat(np.diag(sizes), 2, axis=0)
        moves[1::2] *= -1.0
        # Parameters one by one, then all logarithms at the same values: what is linearised there is the same.
        many = np.repeat(values[None], 2 * len(free) + 1, axis=0)
        many[:-1, list(free)] += moves[: 2 * len(free), : len(free)]
        systems = self._systems(many, logarithms + np.concatenate((moves[:, len(free) :], np.zeros((1, self.size)))))
        steady = _steady(*(each[-1:] for each in systems))
        if not steady.there[0]:
            return None
        rises = [(each[:-1:2] - each[1::2]) / (2.0 * sizes)[:, None, None] for each in systems]
        try:
            slopes = steady.slopes(*rises)
        except np.linalg.LinAlgError:  # at the edge of stability a filter's error never fades
            return None
        return steady.gain[0], np.ascontiguousarray(slopes.reshape(len(sizes), -1).T)

    def _systems(self, values: Array, logarithms: Array) -> tuple[Array, ...]:
        """Transition and output matrices, covariances of process and sensors and of both, for each row of parameter
        values (m, np) and of logarithms (n, q); where the values' rows end, the last one goes on."""
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
        # What a filter makes of a sensor's noise, a trapezoid a row: half shows at once, all from the next row on.
        trapezoid = self.spacing * self.integrated * sensor[:, None, :]
        shown = np.eye(len(self.sensor)) * sensor[:, None, :] + 0.5 * output @ trapezoid
        floor = np.diag((FLOOR * np.maximum(self.process, np.min(self.sensor))) ** 2)
        with np.errstate(invalid="ignore", over="ignore"):  # a motion that no step follows: there is no filter for it
            smooth = half * (process * np.sqrt(self.spacing))[:, None, :]
            density = smooth @ _turned(smooth) + floor + trapezoid @ _turned(trapezoid)
        return transition, output, density, shown @ _turned(shown), trapezoid @ _turned(shown)


def _unit_of(states: Sequence[State], outputs: Sequence[Output]) -> Output | None:
    """The output whose noise is the unit of all others, since only ratios of noises make a gain.

    It is the last output whose noise is estimated and white, which a counted one's is not; where there is none, the
    last output. None where a disturbance is stated: its size is the unit then."""
    if any(each.correlation_time and each.noise_known and each.process_noise > 0.0 for each in states):
        return None
    noisy = [each for each in outputs if not (each.noise_known or each.counted)]
    return noisy[-1] if noisy else outputs[-1]


def _alike(problem: Problem) -> dict[str, str]:
    """Outputs that read exactly as an earlier one in every row: name to the name of that one, and that one's to its
    own."""
    names = [output.name for output in problem.model.outputs]
    same: dict[str, str] = {}
    for place, name in enumerate(names):
        for earlier, other in enumerate(names[:place]):
            if all(np.array_equal(each.measured[:, place], each.measured[:, earlier]) for each in problem.segments):
                same[name] = same.setdefault(other, other)
                break
    return same


def _places(names: Sequence[str], same: dict[str, str], *, first: int) -> tuple[int, ...]:
    """Numbers from `first` on, one for each of `names`, and the same for those that are alike."""
    number: dict[str, int] = {}
    return tuple(number.setdefault(same.get(name, name), first + len(number)) for name in names)


@dataclass(frozen=True, slots=True)
class _Steady:
    """Filters in their steady state: the systems (n, ...), covariances (n, nx, nx) of the state before a row's
    correction and (n, ny, ny) of the innovation, `ahead` (n, nx, ny) the gain of the next row's prediction, `gain` that
    of the filter, and whether one is `there` (n,): NaN where none is."""

    transition: Array
    output: Array
    covariance: Array
    innovation: Array
    ahead: Array
    gain: Array
    there: NDArray[np.bool_]

    @property
    def of_start(self) -> Array:
        """As of NoiseModel, (n, nx, nx)."""
        found = np.zeros_like(self.covariance)
        some = self.there
        output = self.output[some]
        told = _turned(output) @ np.linalg.solve(self.innovation[some], output)
        gathered = in_the_long_run(_turned(self.transition[some] - self.ahead[some] @ output), told)
        found[some] = np.where(np.isfinite(gathered), gathered, 0.0)
        return found

    def slopes(self, transition: Array, output: Array, process: Array, sensor: Array, across: Array) -> Array:
        """The derivatives (m, nx, ny) of the first filter's gain where m derivatives of its system are given.

        The covariance is least in the gain, so it changes as if the gain were held: by a Lyapunov equation.
        """
        A, C, P, L = self.transition[0], self.output[0], self.covariance[0], self.ahead[0]
        closed = A - L @ C
        half = (transition - L @ output) @ P @ closed.T - across @ L.T
        moved = half + _turned(half) + process + L @ sensor @ L.T
        states = len(A)
        system = np.eye(states**2) - np.kron(closed, closed)
        spread = np.linalg.solve(system, moved.reshape(len(moved), -1).T).T.reshape(moved.shape)
        seen = spread @ C.T + P @ _turned(output)
        innovation = output @ P @ C.T + C @ seen + sensor
        ahead = transition @ P @ C.T + A @ seen + across - L @ innovation
        ahead = _turned(np.linalg.solve(self.innovation[0], _turned(ahead)).astype(np.float64))
        return np.asarray(np.linalg.solve(A, ahead - transition @ self.gain[0]))


def _steady(transition: Array, output: Array, process: Array, sensor: Array, across: Array) -> _Steady:
    """The filters whose gains K make x + K (y - C x) the best estimates.

    x+ = A x + w, y = C x + v with covariances process (n, nx, nx), sensor (n, ny, ny), across (n, nx, ny) = E w v'.
    """
    count, outputs, states = output.shape
    finite = np.isfinite(transition).all(axis=(1, 2)) & np.isfinite(process).all(axis=(1, 2))
    covariance, innovation = (np.full((count, size, size), np.nan) for size in (states, outputs))
    ahead, gain = (np.full((count, states, outputs), np.nan) for _ in range(2))
    there = np.zeros(count, dtype=bool)

    def fill(some: NDArray[np.intp]) -> None:
        A, C, Q, R, S = (each[some] for each in (transition, output, process, sensor, across))
        inner = np.linalg.solve(R, np.concatenate((C, _turned(S)), axis=2))
        P = _doubled(A - S @ inner[:, :, :states], _turned(C) @ inner[:, :, :states], Q - S @ inner[:, :, states:])
        settled = np.isfinite(P).all(axis=(1, 2))
        some, A, C, R, S, P = some[settled], A[settled], C[settled], R[settled], S[settled], P[settled]
        covariance[some] = P
        innovation[some] = seen = C @ P @ _turned(C) + R
        ahead[some] = L = _turned(np.asarray(np.linalg.solve(seen, _turned(A @ P @ _turned(C) + S)), dtype=np.float64))
        gain[some] = K = np.linalg.solve(A, L)
        there[some] = np.isfinite(K).all(axis=(1, 2))

    able = np.flatnonzero(finite)
    try:
        fill(able)
    except np.linalg.LinAlgError:  # one of them has none: each alone
        for place in able:
            with suppress(np.linalg.LinAlgError):
                fill(able[able == place])
    return _Steady(transition, output, covariance, innovation, ahead, gain, there)


def _turned(matrices: Array) -> Array:
    return np.swapaxes(matrices, -1, -2)


def _doubled(transition: Array, known: Array, process: Array) -> Array:
    """P = A P (I + G P)^-1 A' + Q by doubling, (n, nx, nx); NaN where it does not settle.

    Raises LinAlgError where one of them has no next step."""
    states = transition.shape[1]
    found = np.full_like(process, np.nan)
    unit = np.eye(states)
    A, G, H = _turned(transition), known, 0.5 * (process + _turned(process))
    left = np.arange(len(found))
    for _ in range(DOUBLINGS):
        if not len(left):
            break
        ratio = np.linalg.solve(unit + G @ H, np.concatenate((A, G), axis=2))
        first, second = ratio[:, :, :states], ratio[:, :, states:]
        with np.errstate(over="ignore", invalid="ignore"):  # what grows beyond all numbers has no steady filter
            grown = H + _turned(A) @ H @ first
            G = G + A @ second @ _turned(A)
            A = A @ first
            # Each state in its own unit: beside 100 N m of a disturbance an angle of 1e-5 rad is nothing, and not
            # settled.
            size = np.sqrt(np.maximum(np.diagonal(grown, axis1=1, axis2=2), 0.0))
            # The error squares with each doubling, so the one after this is exact.
            near = np.abs(grown - H) <= SETTLED * size[:, :, None] * size[:, None, :]
        finite, settled = np.isfinite(grown).all(axis=(1, 2)), near.all(axis=(1, 2))
        found[left[finite & settled]] = 0.5 * (grown + _turned(grown))[finite & settled]
        on = finite & ~settled
        H = grown
        if not on.all():
            left, A, G, H = left[on], A[on], G[on], H[on]
    return found
