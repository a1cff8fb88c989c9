"""Linear quadratic integral (LQI) state feedback for a sampled plant, and its robustness to model errors.

The plant x' = A x + B u, y = C x with one input and one output is discretised exactly for a held input that acts one
period late (the setpoint travels on the bus and waits for the next SYNC). The design state is [x, u of the
previous cycle, q], where q is the integral of y, and the law minimises

    sum over k of  x'Qx + integral * q^2 + effort * u^2,      u = -(state . x + previous * u_before + integral * q)

by the discrete algebraic Riccati equation. The weights apply to the states and the input themselves, so they mean
the same at every sampling rate.

Robustness is assessed on the loop broken at the plant's input: gain margins, phase and delay margin, and the
closed-loop poles at every corner of the uncertain parameters, each also with one more period of delay.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from math import degrees
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import LinAlgError, expm, solve_discrete_are

from telemetry.errors import UprightError

Matrix = NDArray[np.float64]


class ControlDesignError(UprightError):
    """No controller exists for this model, or the one found is not robust to the model's uncertainty."""


@dataclass(frozen=True, slots=True)
class LqiWeights:
    """Weights of the squared states (in the model's order), of the squared integral of the output and of the input."""

    states: tuple[float, ...]
    integral: float
    effort: float


@dataclass(frozen=True, slots=True)
class LqiGains:
    """u = -(states . x + previous * u_before + integral * q); `period` (s) is the sampling period."""

    states: tuple[float, ...]
    previous: float
    integral: float
    period: float


@dataclass(frozen=True, slots=True)
class Margins:
    """Stability margins of the loop at the plant's input.

    `gain_decrease` < 1 < `gain_increase` are the factors on the loop gain at the stability limits (an unstable plant
    has a lower limit, too); `phase` in rad at the worst crossover; `delay` s in addition to the designed one;
    `crossover` rad/s.
    """

    gain_decrease: float
    gain_increase: float
    phase: float
    delay: float
    crossover: float


@dataclass(frozen=True, slots=True)
class Corner:
    """The closed loop at one corner of the uncertain parameters.

    `factors` holds (parameter, factor on its nominal value); `delay` is the total delay, s; `damping` is the worst
    damping ratio, `slowest` (1/s) the decay rate of the slowest pole, negative if the loop is unstable.
    """

    factors: tuple[tuple[str, float], ...]
    delay: float
    damping: float
    slowest: float

    def __str__(self) -> str:
        values = ", ".join(f"{name} x {factor:g}" for name, factor in self.factors)
        return (
            f"{values}, delay {self.delay * 1e3:g} ms: damping {self.damping:.2f}, slowest pole {self.slowest:.2f} 1/s"
        )


@dataclass(frozen=True, slots=True)
class CheckedDesign:
    """A controller with the results of its robustness check. `poles` (1/s) are those of the nominal closed loop;
    `worst` is the worst corner with each uncertain parameter off by `spread` (0.2: 20 %)."""

    gains: LqiGains
    poles: tuple[complex, ...]
    margins: Margins
    worst: Corner
    spread: float

    def findings(self) -> dict[str, Any]:
        """Margins (phase in rad, delay in s) and the worst corner, JSON-ready."""
        margins, worst = self.margins, self.worst
        return {
            "gain_margin": [margins.gain_decrease, margins.gain_increase],
            "phase_margin": margins.phase,
            "delay_margin": margins.delay,
            "worst_corner": {"factors": dict(worst.factors), "delay": worst.delay, "damping": worst.damping},
        }

    def words(self) -> list[str]:
        """The findings as lines of text."""
        margins = self.margins
        return [
            f"controller: gain margins {margins.gain_decrease:.2f} and {margins.gain_increase:.1f}, phase margin "
            f"{degrees(margins.phase):.0f} deg, delay margin {margins.delay * 1e3:.0f} ms",
            f"worst within {100.0 * self.spread:g} % of the CAD values: {self.worst}",
        ]


@dataclass(frozen=True, slots=True)
class StateSpace:
    """x' = A x + B u, y = C x, with the names of states, inputs and outputs."""

    A: Matrix
    B: Matrix
    C: Matrix
    states: tuple[str, ...]
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]


def design_lqi(A: Matrix, B: Matrix, C: Matrix, weights: LqiWeights, period: float) -> LqiGains:
    """The LQI gains for x' = A x + B u, y = C x sampled every `period` seconds with one period of delay.

    Shapes: A (n, n), B (n, 1), C (1, n), `weights.states` n long.

    Raises:
        ControlDesignError: a mode that does not decay by itself is not controllable by the input (its pole is
            named), or the Riccati equation has no stabilising solution for these weights.
    """
    n = len(A)
    if B.shape != (n, 1) or C.shape != (1, n) or len(weights.states) != n:
        raise ValueError(f"shapes do not match: A {A.shape}, B {B.shape}, C {C.shape}, {len(weights.states)} weights")
    Ad, Bd = discretise(A, B, period)
    F = np.zeros((n + 2, n + 2))
    F[:n, :n], F[:n, n : n + 1] = Ad, Bd
    F[n + 1, :n], F[n + 1, n + 1] = period * C[0], 1.0
    G = np.zeros((n + 2, 1))
    G[n, 0] = 1.0
    _require_stabilisable(F, G, period)
    Q = np.diag([*weights.states, 0.0, weights.integral])
    R = np.array([[weights.effort]])
    try:
        P = solve_discrete_are(F, G, Q, R)
        K = np.linalg.solve(R + G.T @ P @ G, G.T @ P @ F)[0]
    except (LinAlgError, ValueError) as error:
        raise ControlDesignError(
            f"the Riccati equation has no stabilising solution ({error}).",
            remedy="every weight except the rate's must be positive; check [controller] in the vehicle file.",
        ) from error
    gains = LqiGains(tuple(float(k) for k in K[:n]), float(K[n]), float(K[n + 1]), period)
    if max(abs(np.linalg.eigvals(F - G @ K[None, :]))) >= 1.0:
        raise ControlDesignError(
            "the Riccati equation's solution does not stabilise the model.",
            remedy="the weights differ by too many powers of ten; check [controller] in the vehicle file.",
        )
    return gains


def discretise(A: Matrix, B: Matrix, period: float) -> tuple[Matrix, Matrix]:
    """The exact (Ad, Bd) of x' = A x + B u for an input held over `period` seconds."""
    n, m = B.shape
    block = np.zeros((n + m, n + m))
    block[:n, :n], block[:n, n:] = A, B
    exponential = expm(block * period)
    return exponential[:n, :n], exponential[:n, n:]


def closed_loop(model: StateSpace, gains: LqiGains, delay_periods: int = 1) -> Matrix:
    """The transition matrix of plant, delay and controller over one period; `model` need not be that of the design."""
    return _open_loop(*discretise(model.A, model.B, gains.period), model.C, gains, delay_periods)[0]


def margins(model: StateSpace, gains: LqiGains) -> Margins:
    """Margins of the loop broken where the setpoint leaves the controller, from its frequency response up to the
    Nyquist frequency."""
    _, F, g, k = _open_loop(*discretise(model.A, model.B, gains.period), model.C, gains, 1)
    omega = np.geomspace(1e-2, np.pi / gains.period, 2000)
    z = np.exp(1j * omega * gains.period)
    loop = np.linalg.solve(z[:, None, None] * np.eye(len(F)) - F, g[:, None])[:, :, 0] @ k
    magnitude, imaginary = np.abs(loop), loop.imag
    crossings = np.flatnonzero(np.diff(np.sign(imaginary)) != 0)
    negative = [float(-loop.real[i]) for i in crossings if loop.real[i] < 0.0]
    increase = min((1.0 / a for a in negative if a < 1.0), default=float("inf"))
    decrease = max((1.0 / a for a in negative if a > 1.0), default=0.0)
    unity = np.flatnonzero(np.diff(np.sign(magnitude - 1.0)) != 0)
    phases = [float((np.angle(loop[i]) + np.pi) % (2.0 * np.pi)) for i in unity]
    worst = min(range(len(unity)), key=lambda i: min(phases[i], 2.0 * np.pi - phases[i]))
    delay = min(phase / float(omega[i]) for phase, i in zip(phases, unity, strict=True))
    phase = min(phases[worst], 2.0 * np.pi - phases[worst])
    return Margins(decrease, increase, phase, delay, float(omega[unity[worst]]))


ModelAt = Callable[[Mapping[str, float]], StateSpace]
"""Gives the model with its uncertain parameters at the given factors of their nominal values, by name."""


def corners(model_at: ModelAt, uncertain: Sequence[str], gains: LqiGains, spread: float) -> Iterator[Corner]:
    """The closed loop with every `uncertain` parameter off by `spread` (0.2: 20 %) in either direction, with one and
    with two periods of delay."""
    for chosen in itertools.product((1.0 - spread, 1.0 + spread), repeat=len(uncertain)):
        factors = tuple(zip(uncertain, chosen, strict=True))
        model = model_at(dict(factors))
        for delay_periods in (1, 2):
            poles = continuous_poles(closed_loop(model, gains, delay_periods), gains.period)
            damping, slowest = _damping(poles)
            yield Corner(factors, delay_periods * gains.period, damping, slowest)


def checked_design(
    model_at: ModelAt, uncertain: Sequence[str], weights: LqiWeights, period: float, *, spread: float = 0.2
) -> CheckedDesign:
    """The LQI of the nominal model, checked over the uncertainty of its parameters.

    Raises ControlDesignError if no controller is found or if it is unstable at a corner; the message names the corner.
    """
    model = model_at({})
    gains = design_lqi(model.A, model.B, model.C, weights, period)
    worst = min(corners(model_at, uncertain, gains, spread), key=lambda corner: (corner.slowest > 0.0, corner.damping))
    if worst.slowest <= 0.0:
        raise ControlDesignError(
            f"the closed loop is unstable when the vehicle differs from its CAD values ({worst}).",
            remedy="raise effort_weight (less bandwidth) or the control rate, or narrow the CAD values' uncertainty.",
        )
    poles = continuous_poles(closed_loop(model, gains), period)
    return CheckedDesign(gains, tuple(complex(pole) for pole in poles), margins(model, gains), worst, spread)


def continuous_poles(transition: Matrix, period: float) -> list[complex]:
    """The poles in 1/s, slowest first, of a transition matrix over `period`; those of pure delays are left out."""
    eigenvalues = np.linalg.eigvals(transition)
    poles = np.log(eigenvalues[np.abs(eigenvalues) > 1e-6].astype(complex)) / period
    return sorted((complex(pole) for pole in poles), key=lambda pole: (-pole.real, pole.imag))


def _damping(poles: list[complex]) -> tuple[float, float]:
    """(worst damping ratio, decay rate of the slowest pole) of poles in 1/s."""
    return min(-pole.real / abs(pole) if pole else 0.0 for pole in poles), min(-pole.real for pole in poles)


def _open_loop(
    Ad: Matrix, Bd: Matrix, C: Matrix, gains: LqiGains, delay_periods: int
) -> tuple[Matrix, Matrix, Matrix, Matrix]:
    """(closed-loop matrix, F, g, k): state [plant, delayed inputs, controller's last output, integral], u = -k x."""
    n, d = len(Ad), delay_periods
    size = n + d + 2
    last, integral = n + d, n + d + 1
    F, g = np.zeros((size, size)), np.zeros(size)
    F[:n, :n] = Ad
    F[integral, :n], F[integral, integral] = gains.period * C[0], 1.0
    if d == 0:
        g[:n] = Bd[:, 0]
    else:
        F[:n, n] = Bd[:, 0]
        for place in range(d - 1):
            F[n + place, n + place + 1] = 1.0
        g[n + d - 1] = 1.0
    k = np.zeros(size)
    k[:n], k[last], k[integral] = gains.states, gains.previous, gains.integral
    closed = F - np.outer(g, k)
    closed[last] = -k
    # With the loop broken at the plant's input, the controller still uses its own last output.
    F[last] = -k
    return closed, F, g, k


def _require_stabilisable(F: Matrix, G: Matrix, period: float) -> None:
    """Popov-Belevitch-Hautus test of every mode on or outside the unit circle."""
    for eigenvalue in sorted(np.linalg.eigvals(F), key=abs, reverse=True):
        if abs(eigenvalue) < 1.0 - 1e-9:
            continue
        pencil = np.hstack([eigenvalue * np.eye(len(F)) - F, G])
        if np.linalg.svd(pencil, compute_uv=False)[-1] < 1e-9:
            pole = np.log(complex(eigenvalue)) / period
            raise ControlDesignError(
                f"the mode at {pole.real:+.2f} 1/s is not controllable by the input: not stabilisable.",
                remedy="leave the state out of the model (as the reduced model does) or check angular_momentum.",
            )
