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

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from estimators.problem import Problem, linearise

Array = NDArray[np.float64]

SPREAD = 1.0
"""Standard deviation, in natural logarithms, of the prior on a noise: a factor of 2.7."""
WIDEST = 6.0
"""Natural logarithm by which a noise may differ from what the model says: a factor of 400."""
STEP = 1e-4
"""Share of its typical size by which an argument of the gain is moved for a derivative."""
FLOOR = 1e-6
"""Process noise that every state has, in units of the process noise the model states: keeps every mode observable."""


@dataclass(frozen=True, slots=True)
class NoiseModel:
    """The noises of a problem. `process` (nx,), unit/sqrt(s), and `sensor` (ny,) are where the estimation starts.

    `noisy` are the states with process noise, `loud` the outputs but the last whose noise is not known: the logarithms,
    (q,), are theirs.
    """

    problem: Problem
    spacing: float
    process: Array
    sensor: Array
    noisy: tuple[int, ...]
    loud: tuple[int, ...]
    integrated: Array
    """Which output's noise is integrated in which state, (nx, ny) of 0 and 1."""

    @classmethod
    def of(cls, problem: Problem) -> NoiseModel:
        """What the model says of its noise."""
        states, outputs = problem.model.states, problem.model.outputs
        process = np.array([state.process_noise for state in states])
        return cls(
            problem=problem,
            spacing=float(np.median(np.diff(problem.segments[0].time))),
            process=process,
            sensor=np.array([output.noise for output in outputs]),
            noisy=tuple(np.flatnonzero(process > 0.0).tolist()),
            loud=tuple(place for place, output in enumerate(outputs[:-1]) if not output.noise_known),
            integrated=np.array([[float(state.noise_of == output.name) for output in outputs] for state in states]),
        )

    @property
    def size(self) -> int:
        """How many logarithms there are, q."""
        return len(self.noisy) + len(self.loud)

    def gain(self, values: Array, logarithms: Array) -> Array | None:
        """The filter gain (nx, ny) at parameter values (np,); None where there is no stable one."""
        gains = steady_gain(*self._covariances(*self._linear(values), logarithms[None]))
        return None if gains is None else gains[0]

    def slopes(self, values: Array, logarithms: Array, free: tuple[int, ...], scale: Array) -> Array | None:
        """The gain's derivatives by the parameters `free` and the logarithms, (nx * ny, p + q): central differences."""
        shifts = STEP * np.repeat(np.eye(self.size), 2, axis=0)
        shifts[1::2] *= -1.0
        here = self._linear(values)
        parts = [self._covariances(*here, logarithms + shifts)]
        for place, size in zip(free, scale, strict=True):
            for sign in (1.0, -1.0):
                moved = values.copy()
                moved[place] += sign * STEP * size
                parts.append(self._covariances(*self._linear(moved), logarithms[None]))
        gains = steady_gain(*(np.concatenate(part) for part in zip(*parts, strict=True)))
        if gains is None:
            return None
        rise = (gains[::2] - gains[1::2]).reshape(len(gains) // 2, -1) / (2.0 * STEP)
        return np.concatenate((rise[self.size :] / scale[:, None], rise[: self.size])).T

    def _linear(self, values: Array) -> tuple[Array, Array]:
        return linearise(self.problem.kernel, values, self.problem.segments, self.spacing)

    def _covariances(self, transition: Array, output: Array, logarithms: Array) -> tuple[Array, ...]:
        """What `steady_gain` takes, for each row of `logarithms`, (m, q)."""
        process = np.tile(self.process, (len(logarithms), 1))
        sensor = np.tile(self.sensor, (len(logarithms), 1))
        factors = np.exp(logarithms)
        process[:, list(self.noisy)] *= factors[:, : len(self.noisy)]
        sensor[:, list(self.loud)] *= factors[:, len(self.noisy) :]
        half = 0.5 * (np.eye(len(transition)) + transition)
        # What a filter makes of a sensor's noise, a trapezoid a row: half shows at once, all from the next row on.
        trapezoid = self.spacing * self.integrated * sensor[:, None, :]
        shown = np.eye(len(output)) * sensor[:, None, :] + 0.5 * output @ trapezoid
        smooth = half * (process * np.sqrt(self.spacing))[:, None, :]
        floor = np.diag((FLOOR * np.maximum(self.process, np.min(self.sensor))) ** 2)
        density = smooth @ _turned(smooth) + floor + trapezoid @ _turned(trapezoid)
        many = (len(logarithms), 1, 1)
        return (
            np.tile(transition, many),
            np.tile(output, many),
            density,
            shown @ _turned(shown),
            trapezoid @ _turned(shown),
        )


def steady_gain(transition: Array, output: Array, process: Array, sensor: Array, across: Array) -> Array | None:
    """The gain K with which x + K (y - C x) is the best estimate, in the steady state; None where there is none.

    x+ = A x + w, y = C x + v with covariances process (m, nx, nx), sensor (m, ny, ny), across (m, nx, ny) = E w v', for
    m systems at once; K is (m, nx, ny).
    """
    states = transition.shape[-1]
    try:
        inner = np.linalg.solve(sensor, np.concatenate((output, _turned(across)), axis=-1))
        reduced = transition - across @ inner[..., :states]
        rest = process - across @ inner[..., states:]
        covariance = _doubled(reduced, _turned(output) @ inner[..., :states], 0.5 * (rest + _turned(rest)))
        if covariance is None:
            return None
        innovation = output @ covariance @ _turned(output) + sensor
        ahead = np.linalg.solve(innovation, _turned(transition @ covariance @ _turned(output) + across))
        gain = np.linalg.solve(transition, _turned(np.asarray(ahead, dtype=np.float64)))
    except np.linalg.LinAlgError:
        return None
    return np.ascontiguousarray(gain) if np.all(np.isfinite(gain)) else None


def _turned(matrices: Array) -> Array:
    return np.swapaxes(matrices, -1, -2)


def _doubled(transition: Array, known: Array, process: Array) -> Array | None:
    """P = A P (I + G P)^-1 A' + Q by doubling, (m, nx, nx); None where it does not settle."""
    states = transition.shape[-1]
    unit = np.eye(states)
    A, G, H = _turned(transition), known, process
    for _ in range(60):
        ratio = np.linalg.solve(unit + G @ H, np.concatenate((A, G), axis=-1))
        first, second = ratio[..., :states], ratio[..., states:]
        grown = H + _turned(A) @ H @ first
        G = G + A @ second @ _turned(A)
        A = A @ first
        size = np.max(np.abs(grown), axis=(-1, -2))
        if not np.all(np.isfinite(size)):
            return None
        # The error squares with each doubling, so the one after this is exact.
        if np.all(np.max(np.abs(grown - H), axis=(-1, -2)) <= 1e-8 * size):
            return np.asarray(0.5 * (grown + _turned(grown)))
        H = grown
    return None
