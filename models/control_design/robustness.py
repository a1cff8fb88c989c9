"""How robust a sampled controller is to errors of its model.

The loop is broken at one input of the plant, with the others closed: gain margins, phase and delay margin. The poles of
the closed loop are computed wherever the uncertain parameters may be, each time also with one more period of delay:
at every corner of a spread about CAD values, or over the joint distribution of estimates. Confirmed effects of the
vehicle (models.control_design.linear_effects), which the design leaves out, are in everything that is checked.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from math import degrees, log
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.special import gammaincinv, ndtri

from upright.models.control_design.lqi import (
    ControlDesignError,
    LqiGains,
    LqiWeights,
    Matrix,
    StateSpace,
    closed_loop,
    continuous_poles,
    design_lqi,
    open_loop,
)
from upright.models.parts import Parameter

REGION = 0.95
"""Probability of the region of the estimates whose corners are checked."""

Factors = tuple[tuple[str, float], ...]
"""Uncertain parameters, each with a factor on its nominal value."""
ModelAt = Callable[[Mapping[str, float]], StateSpace]
"""Gives the model with its uncertain parameters at the given factors of their nominal values, by name."""


class Effects(Protocol):
    """Effects of the real vehicle, as models.control_design.linear_effects has them."""

    @property
    def names(self) -> tuple[str, ...]: ...

    @property
    def left_out(self) -> tuple[str, ...]: ...

    @property
    def parameters(self) -> tuple[Parameter, ...]: ...

    def on(self, plant: StateSpace, factors: Mapping[str, float]) -> StateSpace:
        """`plant` with the effects; parameters of vehicle and effects are at `factors` of their values."""
        ...


class Uncertainty(Protocol):
    """Where the parameters of a model may be."""

    @property
    def words(self) -> str:
        """As in "unstable within ..."."""
        ...

    def plant(self, model_at: ModelAt, factors: Mapping[str, float]) -> StateSpace:
        """The vehicle at a point, with what the design leaves out."""
        ...

    def points(self) -> Iterator[Factors]:
        """All points that a design has to tolerate. Raises ControlDesignError if the parameters are hardly known."""
        ...


@dataclass(frozen=True, slots=True)
class Spread:
    """Each of `names` may be off by `share` (0.2: 20 %) in either direction, whatever the others are."""

    names: tuple[str, ...]
    share: float = 0.2

    @property
    def words(self) -> str:
        return f"{100.0 * self.share:g} % of the CAD values"

    def plant(self, model_at: ModelAt, factors: Mapping[str, float]) -> StateSpace:
        """Nothing is left out."""
        return model_at(factors)

    def points(self) -> Iterator[Factors]:
        """Every corner."""
        for chosen in itertools.product((1.0 - self.share, 1.0 + self.share), repeat=len(self.names)):
            yield tuple(zip(self.names, chosen, strict=True))


@dataclass(frozen=True, slots=True)
class Estimated:
    """`names` were estimated as `values` (k,), with the joint `covariance` (k, k): parameters of the design, and after
    them those of confirmed `effects`."""

    names: tuple[str, ...]
    values: NDArray[np.float64]
    covariance: Matrix
    draws: int = 1000
    effects: Effects | None = None

    @property
    def words(self) -> str:
        words = f"the estimates' {100.0 * REGION:g} % region and {self.draws} draws"
        if self.effects and self.effects.names:
            words += f", with {', '.join(self.effects.names)}"
        if self.effects and self.effects.left_out:
            words += f", without {', '.join(self.effects.left_out)} (no linear model)"
        return words

    def plant(self, model_at: ModelAt, factors: Mapping[str, float]) -> StateSpace:
        """With the effects."""
        theirs = {each.name for each in self.effects.parameters} if self.effects else set()
        plant = model_at({name: factor for name, factor in factors.items() if name not in theirs})
        return self.effects.on(plant, factors) if self.effects else plant

    def points(self) -> Iterator[Factors]:
        """The ends of the principal axes of the region, the corners between them on its surface, and random draws.

        Parameters of the design are positive by nature: points at which one is not, which a value with a large
        deviation has among several others, are no vehicle and are left out. Parameters of effects stay within their
        bounds. Raises ControlDesignError if what is known of a parameter alone does not tell its sign."""
        size = len(self.names)
        extent = ndtri(0.5 + 0.5 * REGION) * np.sqrt(np.diag(self.covariance))
        for place in range(self._designed):
            if self.values[place] <= extent[place]:
                name = self.names[place]
                raise ControlDesignError(
                    f"the estimate of {name} is too uncertain for a controller: it may have the other sign.",
                    remedy="record a longer or stronger excitation, and identify again.",
                )
        squares, axes = np.linalg.eigh(self.covariance)
        axes = axes * np.sqrt(np.maximum(squares, 0.0))
        radius = float(np.sqrt(2.0 * gammaincinv(0.5 * size, REGION)))  # quantile of chi-square
        corners = np.array(list(itertools.product((-1.0, 1.0), repeat=size))) / np.sqrt(size)
        least, most = self._bounds()

        def at(direction: NDArray[np.float64]) -> NDArray[np.float64] | None:
            factors: NDArray[np.float64] = np.clip(self.values + axes @ direction, least, most) / self.values
            return factors if np.min(factors[: self._designed]) > 0.0 else None

        for direction in np.concatenate((radius * np.eye(size), -radius * np.eye(size), radius * corners)):
            if (factors := at(direction)) is not None:
                yield tuple(zip(self.names, factors.tolist(), strict=True))
        random, left = np.random.default_rng(1), self.draws
        while left:
            if (factors := at(random.standard_normal(size))) is not None:
                left -= 1
                yield tuple(zip(self.names, factors.tolist(), strict=True))

    @property
    def _designed(self) -> int:
        """How many parameters are those of the design."""
        return len(self.names) - (len(self.effects.parameters) if self.effects else 0)

    def _bounds(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """The smallest and the largest values that are tried."""
        least, most = np.full(len(self.names), -np.inf), np.full(len(self.names), np.inf)
        if self.effects:
            least[self._designed :] = [each.lower for each in self.effects.parameters]
            most[self._designed :] = [each.upper for each in self.effects.parameters]
        return least, most


@dataclass(frozen=True, slots=True)
class Known:
    """What is known of a vehicle's parameters: `values` by name, SI, their standard `deviations`, and the `correlation`
    of their errors by pair of names; pairs that are not in it are independent. `effects`: its confirmed effects."""

    values: Mapping[str, float]
    deviations: Mapping[str, float]
    correlation: Mapping[tuple[str, str], float]
    effects: Effects | None = None

    def about(self, names: tuple[str, ...]) -> Estimated:
        """What is known of `names`, and of the parameters of the effects."""
        of_effects = self.effects.parameters if self.effects else ()
        values = [*(self.values[name] for name in names), *(each.value for each in of_effects)]
        deviations = [*(self.deviations[name] for name in names), *(each.std for each in of_effects)]
        names += tuple(each.name for each in of_effects)
        pairs = [[1.0 if a == b else self._correlation(a, b) for b in names] for a in names]
        covariance = np.array(pairs) * np.outer(deviations, deviations)
        return Estimated(names, np.array(values), covariance, effects=self.effects)

    def _correlation(self, one: str, other: str) -> float:
        return self.correlation.get((one, other), self.correlation.get((other, one), 0.0))


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
    `margins` by input of the plant; `worst` is the worst point `within` (in words) which its parameters may be."""

    gains: LqiGains
    poles: tuple[complex, ...]
    margins: Mapping[str, Margins]
    worst: Corner
    within: str

    def settling(self, share: float) -> float:
        """s in which the slowest motion of the nominal closed loop decays to `share` of its amplitude."""
        return log(share) / self.poles[0].real

    def findings(self) -> dict[str, Any]:
        """The smallest margins of all inputs (phase in rad, delay in s) and the worst corner, JSON-ready."""
        each, worst = self.margins.values(), self.worst
        return {
            "gain_margin": [max(one.gain_decrease for one in each), min(one.gain_increase for one in each)],
            "phase_margin": min(one.phase for one in each),
            "delay_margin": min(one.delay for one in each),
            "within": self.within,
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
        return [*lines, f"worst within {self.within}: {self.worst}"]


def margins(model: StateSpace, gains: LqiGains) -> dict[str, Margins]:
    """Margins by input, of the loop broken where that setpoint leaves the controller, from its frequency response up to
    the Nyquist frequency. All other setpoints reach the plant."""
    F, G, K = open_loop(model, gains, 1)
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


def corners(model_at: ModelAt, uncertain: Uncertainty, gains: LqiGains) -> Iterator[Corner]:
    """The closed loop at each point of `uncertain`, with one and with two periods of delay."""
    for factors in uncertain.points():
        model = uncertain.plant(model_at, dict(factors))
        for delay_periods in (1, 2):
            poles = continuous_poles(closed_loop(model, gains, delay_periods), gains.period)
            damping, slowest = _damping(poles)
            yield Corner(factors, delay_periods * gains.period, damping, slowest)


def checked_design(model_at: ModelAt, uncertain: Uncertainty, weights: LqiWeights, period: float) -> CheckedDesign:
    """The LQI of the nominal model, checked over the uncertainty of its parameters, with what the design leaves out.

    Raises ControlDesignError if no controller is found or if it is unstable at a point; the message names the point.
    """
    gains = design_lqi(model_at({}), weights, period)
    worst = min(corners(model_at, uncertain, gains), key=lambda corner: (corner.slowest > 0.0, corner.damping))
    if worst.slowest <= 0.0:
        raise ControlDesignError(
            f"the closed loop is unstable within {uncertain.words} ({worst}).",
            remedy="raise effort_weight (less bandwidth) or the control rate, or narrow the uncertainty of the values.",
        )
    plant = uncertain.plant(model_at, {})
    poles = continuous_poles(closed_loop(plant, gains), period)
    return CheckedDesign(gains, tuple(complex(pole) for pole in poles), margins(plant, gains), worst, uncertain.words)


def _damping(poles: list[complex]) -> tuple[float, float]:
    """(worst damping ratio, decay rate of the slowest pole) of poles in 1/s."""
    return min(-pole.real / abs(pole) if pole else 0.0 for pole in poles), min(-pole.real for pole in poles)
