"""The noise of a model in innovations form: from process and sensor noise to the steady Kalman gain.

    x+ = f(x + K e, u),   e = y - h(x, u),   A K = (A P C' + N) S^-1,   S = C P C' + R,   P from the discrete Riccati equation

Process noise is white on the states that name one. Sensor noise is white on every output, and integrated in states that
are what a filter makes of a sensor (N is their common part). The gain depends on ratios only, so the last output's sensor
noise is the unit that all others are told in, as logarithms: these are estimated along with the parameters. The gain
makes a stable predictor of an unstable plant, which is why the prediction error is the sound choice there.
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
        transition, output = linearise(self.problem.kernel, values, self.problem.segments, self.spacing)
        process, sensor = self.process.copy(), self.sensor.copy()
        factors = np.exp(logarithms)
        process[list(self.noisy)] *= factors[: len(self.noisy)]
        sensor[list(self.loud)] *= factors[len(self.noisy) :]
        half = 0.5 * (np.eye(len(transition)) + transition)
        # What a filter makes of a sensor's noise, a trapezoid a row: half of it shows at once, all from the next row on.
        trapezoid = self.spacing * self.integrated * sensor
        shown = np.diag(sensor) + 0.5 * output @ trapezoid
        smooth = half @ np.diag(process * np.sqrt(self.spacing))
        floor = np.diag((FLOOR * np.maximum(self.process, np.min(self.sensor))) ** 2)
        density = smooth @ smooth.T + floor + trapezoid @ trapezoid.T
        return steady_gain(transition, output, density, shown @ shown.T, trapezoid @ shown.T)

    def slopes(self, values: Array, logarithms: Array, free: tuple[int, ...], scale: Array) -> Array | None:
        """Derivatives of the gain by the parameters `free` and the logarithms, (nx * ny, p + q), central differences."""
        columns = []
        for place, size in zip(free, scale, strict=True):
            step = np.zeros_like(values)
            step[place] = 1e-4 * size
            columns.append(self._slope(values + step, values - step, logarithms, logarithms, 2e-4 * size))
        for place in range(self.size):
            step = np.zeros(self.size)
            step[place] = 1e-4
            columns.append(self._slope(values, values, logarithms + step, logarithms - step, 2e-4))
        return None if any(column is None for column in columns) else np.array(columns).T

    def _slope(self, up: Array, down: Array, more: Array, less: Array, width: float) -> Array | None:
        above, below = self.gain(up, more), self.gain(down, less)
        return None if above is None or below is None else ((above - below) / width).ravel()


def steady_gain(transition: Array, output: Array, process: Array, sensor: Array, across: Array) -> Array | None:
    """The gain K with which x + K (y - C x) is the best estimate, in the steady state; None where there is none.

    x+ = A x + w, y = C x + v with covariances process (nx, nx), sensor (ny, ny), across (nx, ny) = E w v'.
    """
    try:
        inner = np.linalg.solve(sensor, np.hstack((output, across.T)))
        reduced = transition - across @ inner[:, : len(transition)]
        known = output.T @ inner[:, : len(transition)]
        rest = process - across @ inner[:, len(transition) :]
        covariance = _doubled(reduced, known, 0.5 * (rest + rest.T))
        if covariance is None:
            return None
        innovation = output @ covariance @ output.T + sensor
        ahead = np.linalg.solve(innovation, (transition @ covariance @ output.T + across).T).T
        gain = np.linalg.solve(transition, ahead)
    except np.linalg.LinAlgError:
        return None
    return np.ascontiguousarray(gain) if np.all(np.isfinite(gain)) else None


def _doubled(transition: Array, known: Array, process: Array) -> Array | None:
    """P = A P (I + G P)^-1 A' + Q by doubling; None where it does not settle."""
    unit = np.eye(len(transition))
    A, G, H = transition.T, known, process
    for _ in range(60):
        ratio = np.linalg.solve(unit + G @ H, np.hstack((A, G)))
        first, second = ratio[:, : len(unit)], ratio[:, len(unit) :]
        grown = H + A.T @ H @ first
        G = G + A @ second @ A.T
        A = A @ first
        if not np.all(np.isfinite(grown)):
            return None
        if np.max(np.abs(grown - H)) <= 1e-8 * np.max(np.abs(grown)):
            return np.asarray(0.5 * (grown + grown.T))
        H = grown
    return None
