"""A compiled model's predictor that runs over control cycles, a chunk at a time, and is adapted by its innovations.

Its unknowns are the estimated parameters and the logarithms of the noise (estimators.fit.innovations), which determine
the Kalman gain, and the initial state of each segment. Innovations are weighted by their covariance, which is estimated
along.

The first chunks are evaluated at start values that may be far off, and derivatives, gain and weights are wrong there,
too. So chunks are kept for a minute. When the unknowns have moved far from the point of linearisation, all chunks are
evaluated again with the unknowns held: a Gauss-Newton step of the batch fit. Until then the unknowns stay within a
reach of that point, since equations that were linearised elsewhere would lead them astray, and a feedback loop at rest
would let this continue. Each re-evaluation is at least a twentieth of free motion later than the last one, so the cost
per cycle stays bounded.

If only the order of magnitude of parameters is known (estimators.fit.logarithms), often only their products are
identifiable. The unknowns are then their logarithms, in which a product is a sum at any point, and chunks between two
re-evaluations are linearised at the point of the last one. If each chunk were linearised at another point, every factor
would seem identifiable: equations that each leave a slightly different direction undetermined leave none undetermined
together.

Without a gain it is a simulation, which restarts every window since the errors of an unstable plant grow without bound.
These errors are autocorrelated, so the covariance follows from the variation of the gradient between chunks. With
little excitation, feedback biases it as any output error: the predictor with a gain is the sound method.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from upright.estimators.contract import Estimate
from upright.estimators.disturbance_estimate import DisturbanceEstimate
from upright.estimators.fit.gauss_newton import Minimum
from upright.estimators.fit.innovations import NoiseModel
from upright.estimators.fit.likelihood import FLOOR
from upright.estimators.fit.logarithms import is_known_roughly
from upright.estimators.fit.problem import Problem
from upright.estimators.fit.random.disturbance import Found, is_of_disturbance, of_joints
from upright.estimators.fit.result import assemble
from upright.estimators.fit.stationary_start import stationary_spread
from upright.estimators.recursive.frame_chunks import Chunk, join
from upright.estimators.recursive.gauss_newton import ROUNDING, SLIGHT, RecursiveGaussNewton
from upright.models.compiler.kernel import Memory
from upright.models.parts import Output
from upright.models.segment import Segment
from upright.models.text.expressions import number

Array = NDArray[np.float64]

GAIN_MOVES = (0.5, 0.5)
"""The gain is computed again after a move of a parameter in typical magnitudes, or of the natural logarithm of a noise
or of its correlation time, by this."""
FAR, REACH = (0.05, 0.3), (0.5, 0.5)
"""In the same units: the move after which the kept chunks are evaluated again, and the farthest move before that."""
SOONEST, USUAL, ROUGH, URGENT = 0.5, 1.2, 1.1, 1.05
"""s of free motion before the first re-evaluation, and factors of free motion to the next one: `ROUGH` if parameters
are known roughly (for all models, a live diagnosis named something in 3 of 40 clean records instead of 1), `URGENT` if
the reach limits the unknowns."""
KEPT = 64.0
"""s of free motion after which no chunks are kept any more."""
JOINED = 40
"""Chunks that are joined into one for a re-evaluation."""
STALE = 1e-3
"""Factor on the weight of the innovations' covariance when all innovations are computed again."""
ABSURD = 30.0
"""Standard deviations that no innovation of a working predictor exceeds."""
IDENTICAL = 0.01
"""Noise added to a counted output, relative to its own, in case it is identical to another, as with both wheels of a
vehicle that is symmetric to the last bit: together they have no more information than one of them."""
LOGARITHM, OF_NOISE = 0.5, 1.0
"""Typical magnitude of the logarithm of a roughly known parameter, and of that of a correlation time of a noise, as of
the noise itself."""
WIDE = 10.0
"""Prior standard deviation of a parameter without a prior, in typical magnitudes."""


@dataclass(frozen=True, slots=True)
class Seen:
    """With what a chunk of n samples was predicted, and the result, for use beyond this model.

    `values` (np,), `gain` (nx, ny); `whitening` (ny, ny) turns an innovation into independent ones of unit variance.
    `residual` (n * ny,) are the whitened innovations. `columns` (n * ny, m) are the whitened derivatives of the
    prediction with respect to the unknowns z (nz,), the segment's initial state and the held parameters that are not
    exactly known, per typical magnitude or standard deviation. `prior` (m,) is one over their variances. If `count` is
    not 0, all chunks so far are evaluated again: this is number `place` of `count`.
    """

    chunk: Chunk
    values: Array
    gain: Array | None
    whitening: Array
    residual: Array
    columns: Array
    z: Array
    prior: Array
    place: int
    count: int


class RecursivePredictor:
    """`problem` without data states what is estimated; the sampling period is `period` s.

    `memory` (s) is the time constant of forgetting. Without `corrected` it is a simulation. `watch` is called with
    every chunk that is used, when it arrives and at every re-evaluation.
    """

    def __init__(
        self,
        problem: Problem,
        period: float,
        memory: float,
        *,
        corrected: bool,
        watch: Callable[[Seen], None] | None = None,
    ) -> None:
        self._problem, self._period, self._memory = problem, period, memory
        self._watch = watch
        self._noise = NoiseModel.of(problem) if corrected else None
        model, kernel = problem.model, problem.kernel
        free, logarithms = len(problem.free), self._noise.size if self._noise else 0
        self._roughly = np.array([is_known_roughly(parameter) for parameter in problem.parameters], dtype=bool)
        # The correlation time of a disturbance is known roughly, too, but is not a factor of a product that is better
        # known.
        shaken = of_noise(problem)
        self._shaken = tuple(np.flatnonzero(shaken).tolist())
        self._shaken_states = any(state.correlation_time for state in model.base_states)
        self._machine = np.flatnonzero(~shaken)
        self._one_place = bool((self._roughly & ~shaken).any())
        self._logarithm = np.where(shaken, OF_NOISE, LOGARITHM)
        self._usual = ROUGH if self._one_place else USUAL
        parameters, states, outputs = len(kernel.parameters), len(kernel.states), len(kernel.outputs)
        gains = range(states * outputs) if self._noise else ()
        self._active = (
            *problem.free,
            *(parameters + place for place in problem.own),
            *problem.uncertain,
            *(parameters + states + entry for entry in gains),
        )
        spread = problem.spread
        held = [model.parameters[place].std for place in problem.uncertain]
        self._others = np.concatenate((spread, held))
        self._own = slice(free, free + len(spread))
        self._free = free
        self._start, (self._lower, self._upper) = problem.start, problem.bounds
        self._scale = np.where(self._roughly, self._logarithm * self._start, problem.scale)
        known = np.array([p.std if p.std > 0.0 else WIDE * p.typical for p in problem.parameters])
        widest, vague = (self._noise.widest, self._noise.spread) if self._noise else (np.zeros(0), np.zeros(0))
        prior = np.concatenate(((self._scale / known) ** 2, vague**-2))
        self._prior = np.concatenate((prior, np.ones(len(spread) + len(held))))
        self._initial = slice(len(prior), len(prior) + len(spread))
        self._regression = RecursiveGaussNewton(
            prior,
            np.concatenate((self._inside(self._lower), -widest)),
            np.concatenate((self._inside(self._upper), widest)),
            estimated=free,
            own=len(spread),
            held=len(held),
            nuisance=self._shaken,
            clustered=self._noise is None,
        )
        shares = [_share(output, corrected=corrected) for output in model.outputs]
        self._floor = np.diag(
            [(share * output.noise) ** 2 for share, output in zip(shares, model.outputs, strict=True)]
        )
        self._squares = np.diag(np.square([output.noise for output in model.outputs]))
        self._weight = 1.0
        self._state: Memory | None = None
        self._gain_at: Array | None = None
        self._gain_now: Array | None = None
        self._gain = np.zeros((states, outputs))
        self._gain_slopes = np.zeros((len(gains), len(self._shaken) + logarithms))
        self._kept: list[Chunk] = []
        self._seen_from, self._seen_at = self._regression.z, 0.0
        self._rounds = 0
        self._settled = True
        noisy = np.concatenate((shaken & self._roughly, np.ones(logarithms, dtype=bool)))
        self._far, self._reach, self._gain_moves = (
            np.where(noisy, of_a_noise, of_a_parameter) for of_a_parameter, of_a_noise in (FAR, REACH, GAIN_MOVES)
        )
        self._gain_unknowns = np.array([*self._shaken, *range(free, free + logarithms)], dtype=np.int64)
        self.rows = 0
        """Samples that were used."""
        self.span = 0.0
        """s of free motion."""
        self.lost = 0
        """How often the innovations were absurd."""

    def take(self, chunk: Chunk) -> None:
        """Take the next chunk. One with absurd innovations is left out; the predictor then restarts."""
        if self._state is None:
            chunk = chunk.as_first()
        latest = self._regression.z
        if self._one_place:  # the chunk is linearised there
            self._regression.z = self._seen_from
        error, slopes = self._predict(chunk)
        if not self._is_possible(error, slopes):
            self._regression.z = latest
            self._state = None
            self.lost += bool(self.rows)
            return
        self.rows += len(error)
        self.span += len(error) * self._period
        self._learn_noise(error, slopes)
        self._gather(chunk, error, slopes)
        if self.span > KEPT:
            self._kept.clear()
            self._regression.move(self._regression.z, self._reach)
            if np.any(np.abs(self._regression.z - self._seen_from) > (1.0 + ROUNDING) * self._reach):
                self._seen_from = self._regression.z
            return
        self._kept.append(chunk)
        held_back = self._regression.move(self._seen_from, self._reach)
        moved = np.abs(self._regression.z - self._seen_from)
        again_at = max(SOONEST, self._seen_at * (URGENT if held_back or self._noise is None else self._usual))
        far = moved > self._far
        # If a noise has little effect, all its values are equally likely, and its linearisation point does not matter.
        if not far[self._machine].any() and self._regression.side_deviations(self._seen_from) <= SLIGHT:
            far[:] = False
        if self.span >= again_at and far.any():
            moved = self._learn_again()
        self._settled = bool(np.all(moved[self._machine] < 0.99 * self._reach[self._machine]))

    def estimate(self, method: str) -> Estimate:
        """The present estimate, under the name `method`."""
        uncertainty = self._regression.uncertainty()
        sizes = self._sizes
        units = np.outer(sizes, sizes)
        common = self._values[list(self._problem.free)]
        minimum = Minimum(
            common=common,
            own=(),
            cost=0.0,
            blocks=(),
            information=np.zeros((self._free, self._free)),
            iterations=self._rounds,
            converged=self._settled,
            at_bound=(common <= self._lower) | (common >= self._upper),
        )
        return assemble(
            self._problem,
            method,
            minimum,
            covariance=uncertainty.total * units,
            data_covariance=uncertainty.alone * units,
            fit_percent={},
            seconds=0.0,
            disturbance=self._disturbance(uncertainty.every),
        )

    def disturbance(self) -> tuple[DisturbanceEstimate, ...]:
        """The disturbances, as in `estimate`."""
        return self._disturbance(self._regression.uncertainty().every) if self._shaken_states else ()

    def _disturbance(self, covariance: Array) -> tuple[DisturbanceEstimate, ...]:
        """The disturbances; `covariance` (n, n) is that of the unknowns."""
        if self._noise is None or not self._shaken_states:
            return ()
        sizes = np.concatenate((self._sizes, np.ones(self._noise.size)))
        values, logarithms = self._values, self._regression.z[self._free :]
        found = covariance * np.outer(sizes, sizes)
        return of_joints(Found(self._noise, values, logarithms, found, self._covariance(), self.rows))

    @property
    def _values(self) -> Array:
        """Values of all parameters, (np,)."""
        moved = self._regression.z[: self._free]
        rough = self._start * np.exp(np.where(self._roughly, self._logarithm * moved, 0.0))
        common = np.where(self._roughly, rough, self._start + self._scale * moved)
        return self._problem.values(np.clip(common, self._lower, self._upper))

    @property
    def _sizes(self) -> Array:
        """Change of each estimated parameter's value per unit of its unknown, at the present values, (p,)."""
        values = self._values[list(self._problem.free)]
        return np.where(self._roughly, self._logarithm * values, self._scale)

    def _inside(self, values: Array) -> Array:
        """The unknowns (p,) at `values` (p,) of the estimated parameters."""
        ratio = np.where(self._roughly, values / np.where(self._roughly, self._start, 1.0), 1.0)
        return np.where(self._roughly, np.log(ratio) / self._logarithm, (values - self._start) / self._scale)

    def _predict(self, chunk: Chunk) -> tuple[Array, Array]:
        """Innovations of `chunk`, (n, ny), and the derivatives of its predictions, (n, ny, active)."""
        segment, rows = chunk.segment, chunk.rows
        values = self._values
        if self._state is None or chunk.begins:
            initial = measured_state(self._problem, segment.measured[chunk.first])
            self._state = self._problem.kernel.memory(initial, self._active)
        else:
            self._state.pointer[:] = inputs_at(self._problem, segment, chunk.first, values)
        gain = self._gain_now = self._steady(values)
        predicted = np.empty_like(segment.measured)
        slopes = np.empty((*segment.measured.shape, len(self._active)))
        self._problem.kernel.proceed(
            segment,
            values,
            self._state,
            gain,
            self._active,
            predicted,
            slopes,
            first=chunk.first,
            last=chunk.last,
            substeps=self._problem.substeps,
            skip=not chunk.begins,
        )
        return segment.measured[rows] - predicted[rows], slopes[rows]

    def _gather(self, chunk: Chunk, error: Array, slopes: Array, *, again: tuple[int, int] = (0, 0)) -> None:
        """Add the errors to the regression, weighted by their present covariance. `again`: (place, count) in a
        re-evaluation."""
        if chunk.begins:
            self._prior[self._initial] = self._start_precision()
            self._regression.begin(self._prior[self._initial])
        whitening = self._whitening()
        white = (whitening @ slopes).reshape(error.size, -1)
        free = self._free
        direct = free + len(self._others)
        scaled = white[:, :direct] * np.concatenate((self._sizes, self._others))
        by_gain = white[:, direct:] @ self._gain_slopes
        scaled[:, self._shaken] += by_gain[:, : len(self._shaken)]
        columns = np.concatenate((scaled[:, :free], by_gain[:, len(self._shaken) :], scaled[:, free:]), axis=1)
        residual = (error @ whitening.T).ravel()
        self._regression.add(residual, columns, self._kept_share(error))
        if self._watch is not None:
            z = self._regression.z.copy()
            used = (self._values, self._gain_now, whitening)
            self._watch(Seen(chunk, *used, residual, columns, z, self._prior, *again))

    def _start_precision(self) -> Array:
        """One over the variances (k,) of the next segment's initial state, in the units of its columns: a disturbance
        begins stationary."""
        if self._noise is None:
            return np.ones(len(self._problem.spread))
        spread = stationary_spread(self._noise, self._values, self._regression.z[self._free :])
        return np.asarray((self._problem.spread / spread) ** 2)

    def _learn_again(self) -> Array:
        """Evaluate all kept chunks again at the present unknowns; returns how far the unknowns then move, (n,)."""
        self._seen_at = self.span
        chunks = list(join(self._kept, JOINED))
        seen = [self._predict(chunk) for chunk in chunks]
        if not all(np.isfinite(slopes).all() for _, slopes in seen):
            self._state = None
            return self._reach
        self._rounds += 1
        self._regression.forget()
        self._squares *= STALE
        self._weight *= STALE
        for error, slopes in seen:
            self._learn_noise(error, slopes)
        for place, (chunk, (error, slopes)) in enumerate(zip(chunks, seen, strict=True)):
            self._gather(chunk, error, slopes, again=(place, len(chunks)))
        self._seen_from = self._regression.z
        self._regression.move(self._seen_from, self._reach)
        return np.abs(self._regression.z - self._seen_from)

    def _kept_share(self, error: Array) -> float:
        return math.exp(-len(error) * self._period / self._memory)

    def _steady(self, values: Array) -> Array | None:
        """The gain at the present unknowns: linearised at the unknowns for which it was last computed."""
        if self._noise is None:
            return None
        z, free = self._regression.z, self._free
        if self._gain_at is not None:
            moved = z - self._gain_at
            # An unknown that has moved to its reach has moved just as far as this limit, and rounding must not decide.
            if (np.abs(moved) < (1.0 - ROUNDING) * self._gain_moves).all():
                return self._gain + (self._gain_slopes @ moved[self._gain_unknowns]).reshape(self._gain.shape)
        times = tuple(self._problem.free[place] for place in self._shaken)
        found = self._noise.steady_state(values, z[free:], times, values[list(times)])
        if found is not None:
            self._gain, slopes = found.gain, found.slopes.copy()
            slopes[:, : len(times)] *= self._sizes[list(self._shaken)]
            self._gain_slopes, self._gain_at = np.ascontiguousarray(slopes), z
        return self._gain

    def _is_possible(self, error: Array, slopes: Array) -> bool:
        """Whether the predictor still follows the vehicle. If not, the noise may only be larger than assumed, so its
        estimate is updated within bounds. If only the order of magnitude of parameters is known, the first innovations
        are not tested."""
        if not (np.isfinite(error).all() and np.isfinite(slopes).all()):
            return False
        if self._noise is None or (self._one_place and self.span < SOONEST):
            return True
        largest = ABSURD * np.sqrt(np.diagonal(self._covariance()))
        if (np.abs(error) <= largest).all():
            return True
        self._add_squares(np.clip(error, -largest, largest))
        return False

    def _learn_noise(self, error: Array, slopes: Array) -> None:
        # With roughly known parameters, initial states may be far from their measured values, which is not noise.
        as_it_is = self._noise is not None and not self._one_place
        self._add_squares(error if as_it_is else self._without_start(error, slopes))

    def _add_squares(self, error: Array) -> None:
        kept = self._kept_share(error)
        self._squares = kept * self._squares + error.T @ error
        self._weight = kept * self._weight + len(error)

    def _covariance(self) -> Array:
        """Covariance of an innovation, (ny, ny)."""
        covariance = self._squares / self._weight + self._floor
        return covariance if self._noise else np.diag(np.diagonal(covariance))

    def _whitening(self) -> Array:
        """Matrix (ny, ny) that turns an innovation into independent ones of unit variance."""
        return np.linalg.inv(np.linalg.cholesky(self._covariance()))

    def _without_start(self, error: Array, slopes: Array) -> Array:
        """`error` (n, ny) minus the part that an error of the measured initial state explains."""
        whitening = self._whitening()
        spread = self._others[: self._own.stop - self._own.start]
        own = (whitening @ slopes[:, :, self._own]).reshape(error.size, -1) * spread
        start = np.linalg.solve(own.T @ own + np.eye(own.shape[1]), own.T @ (error @ whitening.T).ravel())
        explained: Array = slopes[:, :, self._own] @ (spread * start)
        return error - explained


def of_noise(problem: Problem) -> NDArray[np.bool_]:
    """Mask (p,) of the estimated parameters that belong to a disturbance, and not to the machine."""
    times = is_of_disturbance(problem.model)
    return np.array([parameter.name in times for parameter in problem.parameters], dtype=bool)


def _share(output: Output, *, corrected: bool) -> float:
    """Standard deviation that is added to an output's innovations, as a share of its noise."""
    if corrected and output.noise_known:
        return FLOOR
    return IDENTICAL if output.counted else 1e-9


def inputs_at(problem: Problem, segment: Segment, row: int, values: Array) -> NDArray[np.int64]:
    """Index (nu,) of the sample of each input that acts at `row`, at parameter `values` (np,)."""
    late = [sum(values[problem.kernel.index(name)] for name in each.delays) for each in problem.model.inputs]
    passed = np.count_nonzero(segment.knots + late < segment.time[row], axis=0)
    return np.asarray(np.maximum(passed - 1, 0))


def measured_state(problem: Problem, measured: Array) -> Array:
    """The state (nx,) from the outputs `measured` (ny,)."""
    shown = zip(problem.kernel.outputs, map(float, measured), strict=True)
    known = {**problem.model.values, **dict(shown)}
    states = problem.model.states
    return np.array([number(state.initial, known, f"state {state.name}, initial") for state in states])
