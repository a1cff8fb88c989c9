"""Linear quadratic integral (LQI) state feedback for a sampled plant, and its robustness to model errors.

The plant x' = A x + B u, y = C x with n states, m inputs and p outputs is discretised exactly for held inputs that act
one period late (the setpoints travel on the bus and wait for the next SYNC). The design state is [x, u of the previous
cycle, q], where q is the integral of y, and the law minimises

    sum over k of  x'Qx + q'diag(integral) q + u'diag(effort) u,     u = -(states x + previous u_before + integral q)

by the discrete algebraic Riccati equation. The weights apply to the states and the inputs themselves, so they mean
the same at every sampling rate. States that nothing measures, such as the acceleration in a speed loop, the controller
computes from its own setpoints, by the model: an observer without correction, for which they must decay by themselves.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import LinAlgError, expm, solve_discrete_are

from upright.telemetry.errors import UprightError

Matrix = NDArray[np.float64]


class ControlDesignError(UprightError):
    """No controller exists for this model, or the one found is not robust to the model's uncertainty."""


@dataclass(frozen=True, slots=True)
class LqiWeights:
    """Weights of the squared states, of the squared integrals of the outputs and of the squared inputs, in the model's
    order."""

    states: tuple[float, ...]
    integral: tuple[float, ...]
    effort: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class LqiGains:
    """u = -(states x + previous u_before + integral q), row by row: `states` (m, n), `previous` (m, m), `integral`
    (m, p); `period` (s) is the sampling period. `computed`: the states of x that nothing measures, None if there are
    none."""

    states: tuple[tuple[float, ...], ...]
    previous: tuple[tuple[float, ...], ...]
    integral: tuple[tuple[float, ...], ...]
    period: float
    computed: Computed | None = None

    @property
    def matrix(self) -> Matrix:
        """All gains (m, n + m + p), for the state [x, u_before, q]."""
        return np.hstack([np.array(each) for each in (self.states, self.previous, self.integral)])


@dataclass(frozen=True, slots=True)
class StateSpace:
    """x' = A x + B u, y = C x, with the names of states, inputs and outputs; nothing measures the `computed` states.

    `measured` (k, n): what a controller sees of the k `states`, if there are further states or errors of sensors (as
    by models.control_design.linear_effects); None if it sees x itself.
    """

    A: Matrix
    B: Matrix
    C: Matrix
    states: tuple[str, ...]
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    computed: tuple[str, ...] = ()
    measured: Matrix | None = None


@dataclass(frozen=True, slots=True)
class Computed:
    """How a controller computes the states z (k,) that nothing measures, and those they depend on: one period later
    they are transition z + inputs u_before, with `transition` (k, k) and `inputs` (k, m). z are the model's states
    `places`, of which `used` are not measured."""

    transition: Matrix
    inputs: Matrix
    places: tuple[int, ...]
    used: tuple[int, ...]

    @classmethod
    def of(cls, model: StateSpace, period: float) -> Computed:
        """For the `computed` states of a model. Raises ControlDesignError if they do not decay by themselves."""
        used = [model.states.index(name) for name in model.computed]
        chosen, before = sorted(used), list[int]()
        while chosen != before:  # with all that these depend on
            before = chosen
            chosen = sorted({*before, *np.flatnonzero(model.A[before].any(axis=0)).tolist()})
        A = model.A[np.ix_(chosen, chosen)]
        if len(A) and max(np.linalg.eigvals(A).real) >= 0.0:
            names = ", ".join(model.computed)
            raise ControlDesignError(
                f"{names} cannot be computed from the setpoints: they do not decay by themselves.",
                remedy="measure them, or leave them out of the model.",
            )
        transition, inputs = discretise(A, model.B[chosen], period)
        return cls(transition, inputs, tuple(chosen), tuple(used))


def design_lqi(model: StateSpace, weights: LqiWeights, period: float) -> LqiGains:
    """The LQI gains for a model that is sampled every `period` seconds, with one period of delay.

    Raises:
        ControlDesignError: a mode that does not decay by itself is not controllable by the inputs (its pole is
            named), or the Riccati equation has no stabilising solution for these weights.
        ValueError: the numbers of weights are not those of states, outputs and inputs.
    """
    (n, m), p = model.B.shape, len(model.C)
    if (len(weights.states), len(weights.integral), len(weights.effort)) != (n, p, m):
        numbers = f"{len(weights.states)}, {len(weights.integral)} and {len(weights.effort)} weights"
        raise ValueError(f"{numbers} for {n} states, {p} outputs and {m} inputs")
    F = np.zeros((n + m + p, n + m + p))
    F[:n, :n], F[:n, n : n + m] = discretise(model.A, model.B, period)
    F[n + m :, :n], F[n + m :, n + m :] = period * model.C, np.eye(p)
    G = np.zeros((n + m + p, m))
    G[n : n + m] = np.eye(m)
    _require_stabilisable(F, G, period)
    Q = np.diag([*weights.states, *[0.0] * m, *weights.integral])
    R = np.diag(weights.effort)
    try:
        P = solve_discrete_are(F, G, Q, R)
        K = np.linalg.solve(R + G.T @ P @ G, G.T @ P @ F)
    except (LinAlgError, ValueError) as error:
        raise ControlDesignError(
            f"the Riccati equation has no stabilising solution ({error}).",
            remedy="every weight except the rate's must be positive; check [controller] in the vehicle file.",
        ) from error
    rows = [tuple(map(tuple, part.tolist())) for part in (K[:, :n], K[:, n : n + m], K[:, n + m :])]
    gains = LqiGains(rows[0], rows[1], rows[2], period, Computed.of(model, period) if model.computed else None)
    if max(abs(np.linalg.eigvals(F - G @ K))) >= 1.0:
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
    F, G, K = open_loop(model, gains, delay_periods)
    return F - G @ K


def continuous_poles(transition: Matrix, period: float) -> list[complex]:
    """The poles in 1/s, slowest first, of a transition matrix over `period`; those of pure delays are left out."""
    eigenvalues = np.linalg.eigvals(transition)
    poles = np.log(eigenvalues[np.abs(eigenvalues) > 1e-6].astype(complex)) / period
    return sorted((complex(pole) for pole in poles), key=lambda pole: (-pole.real, pole.imag))


def open_loop(model: StateSpace, gains: LqiGains, delay_periods: int) -> tuple[Matrix, Matrix, Matrix]:
    """F, G, K over one period: u = -K x, with the state [plant, delayed inputs, controller's last outputs, integrals,
    computed states]."""
    (n, m), p, d, computed = model.B.shape, len(model.C), delay_periods, gains.computed
    Ad, Bd = discretise(model.A, model.B, gains.period)
    last, integral = n + d * m, n + (d + 1) * m
    own = integral + p
    size = own + (len(computed.places) if computed else 0)
    F, G = np.zeros((size, size)), np.zeros((size, m))
    F[:n, :n] = Ad
    F[integral:own, :n], F[integral:own, integral:own] = gains.period * model.C, np.eye(p)
    if d == 0:
        G[:n] = Bd
    else:
        F[:n, n : n + m] = Bd
        F[n : n + (d - 1) * m, n + m : last] = np.eye((d - 1) * m)
        G[last - m : last] = np.eye(m)
    G[last:integral] = np.eye(m)
    K, of_states = np.zeros((m, size)), np.array(gains.states)
    K[:, last:integral], K[:, integral:own] = gains.previous, gains.integral
    if computed:
        F[own:, own:], F[own:, last:integral] = computed.transition, computed.inputs
        for place in computed.used:
            K[:, own + computed.places.index(place)], of_states[:, place] = of_states[:, place], 0.0
    K[:, :n] = of_states if model.measured is None else of_states @ model.measured
    return F, G, K


def _require_stabilisable(F: Matrix, G: Matrix, period: float) -> None:
    """Popov-Belevitch-Hautus test of every mode on or outside the unit circle."""
    for eigenvalue in sorted(np.linalg.eigvals(F), key=abs, reverse=True):
        if abs(eigenvalue) < 1.0 - 1e-9:
            continue
        pencil = np.hstack([eigenvalue * np.eye(len(F)) - F, G])
        if np.linalg.svd(pencil, compute_uv=False)[-1] < 1e-9:
            pole = np.log(complex(eigenvalue)) / period
            raise ControlDesignError(
                f"the mode at {pole.real:+.2f} 1/s is not controllable by any input: not stabilisable.",
                remedy="leave the state out of the model (as the reduced model does) or check angular_momentum.",
            )
