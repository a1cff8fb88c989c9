"""Linear quadratic integral (LQI) state feedback for a sampled plant, and its robustness to model errors.

The plant x' = A x + B u, y = C x with n states, m inputs and p outputs is discretised exactly for held inputs that act
one period late (the setpoints travel on the bus and wait for the next SYNC). The design state is [x, u of the previous
cycle, q], where q is the integral of y, and the law minimises

    sum over k of  x'Qx + q'diag(integral) q + u'diag(effort) u,     u = -(states x + previous u_before + integral q)

by the discrete algebraic Riccati equation. The weights apply to the states and the inputs themselves, so they mean
the same at every sampling rate. States that nothing measures, such as the acceleration in a speed loop, the controller
computes from its own setpoints, by the model: an observer without correction, for which they must decay by themselves.

Robustness is assessed on the loop broken at one input of the plant, with the others closed: gain margins, phase and
delay margin; and by the closed-loop poles at every corner of the uncertain parameters, each also with one more period
of delay.
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
class Margins:
    """Stability margins of the loop at one input of the plant.

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
    `margins` by input of the plant; `worst` is the worst corner with each uncertain parameter off by `spread` (0.2:
    20 %)."""

    gains: LqiGains
    poles: tuple[complex, ...]
    margins: Mapping[str, Margins]
    worst: Corner
    spread: float

    def findings(self) -> dict[str, Any]:
        """The smallest margins of all inputs (phase in rad, delay in s) and the worst corner, JSON-ready."""
        each, worst = self.margins.values(), self.worst
        return {
            "gain_margin": [max(one.gain_decrease for one in each), min(one.gain_increase for one in each)],
            "phase_margin": min(one.phase for one in each),
            "delay_margin": min(one.delay for one in each),
            "worst_corner": {"factors": dict(worst.factors), "delay": worst.delay, "damping": worst.damping},
        }

    def words(self, name: str = "") -> list[str]:
        """The findings as lines of text; `name` of the controller if there are several."""
        lines, title = [], f"{name} controller".strip()
        for place, margins in self.margins.items():
            at = f" at {place}" if len(self.margins) > 1 else ""
            lines.append(
                f"{title}{at}: gain margins {margins.gain_decrease:.2f} and {margins.gain_increase:.1f}, phase "
                f"margin {degrees(margins.phase):.0f} deg, delay margin {margins.delay * 1e3:.0f} ms"
            )
        return [*lines, f"worst within {100.0 * self.spread:g} % of the CAD values: {self.worst}"]


@dataclass(frozen=True, slots=True)
class StateSpace:
    """x' = A x + B u, y = C x, with the names of states, inputs and outputs; nothing measures the `computed` states."""

    A: Matrix
    B: Matrix
    C: Matrix
    states: tuple[str, ...]
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    computed: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Computed:
    """How a controller computes the states z (k,) that nothing measures, and those they depend on: one period later
    they are transition z + inputs u_before. z are the model's states `places`, of which `used` are not measured."""

    transition: Matrix
    inputs: Matrix
    places: tuple[int, ...]
    used: tuple[int, ...]

    @classmethod
    def of(cls, model: StateSpace, period: float) -> Computed:
        """For the `computed` states of a model. Raises ControlDesignError if they do not decay by themselves."""
        used = [model.states.index(name) for name in model.computed]
        places = set(used)
        while (more := {int(j) for i in places for j in np.flatnonzero(model.A[i])} | places) != places:
            places = more
        chosen = sorted(places)
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
    F, G, K = _open_loop(model, gains, delay_periods)
    return F - G @ K


def margins(model: StateSpace, gains: LqiGains) -> dict[str, Margins]:
    """Margins by input, of the loop broken where that setpoint leaves the controller, from its frequency response up to
    the Nyquist frequency. All other setpoints reach the plant."""
    F, G, K = _open_loop(model, gains, 1)
    omega = np.geomspace(1e-2, np.pi / gains.period, 2000)
    z = np.exp(1j * omega * gains.period)[:, None, None]
    last = len(model.A) + len(model.inputs)
    found = {}
    for number, name in enumerate(model.inputs):
        g = G[:, number].copy()
        # With the loop broken at the plant's input, the controller still uses its own last output.
        g[last + number] = 0.0
        broken = F - G @ K + np.outer(g, K[number])
        loop = np.linalg.solve(z * np.eye(len(F)) - broken, g[:, None])[:, :, 0] @ K[number]
        found[name] = _margins(loop, omega)
    return found


def _margins(loop: NDArray[np.complex128], omega: Matrix) -> Margins:
    """Margins of a frequency response at `omega` rad/s, which is -1 at the stability limit."""
    magnitude, imaginary = np.abs(loop), loop.imag
    crossings = np.flatnonzero(np.diff(np.sign(imaginary)) != 0)
    negative = [float(-loop.real[i]) for i in crossings if loop.real[i] < 0.0]
    increase = min((1.0 / a for a in negative if a < 1.0), default=float("inf"))
    decrease = max((1.0 / a for a in negative if a > 1.0), default=0.0)
    unity = np.flatnonzero(np.diff(np.sign(magnitude - 1.0)) != 0)
    if not len(unity):
        return Margins(decrease, increase, np.pi, float("inf"), 0.0)
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
    gains = design_lqi(model, weights, period)
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


def _open_loop(model: StateSpace, gains: LqiGains, delay_periods: int) -> tuple[Matrix, Matrix, Matrix]:
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
    K = np.zeros((m, size))
    K[:, :n], K[:, last:integral], K[:, integral:own] = gains.states, gains.previous, gains.integral
    if computed:
        F[own:, own:], F[own:, last:integral] = computed.transition, computed.inputs
        for place in computed.used:
            K[:, own + computed.places.index(place)], K[:, place] = K[:, place], 0.0
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
