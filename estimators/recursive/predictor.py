"""A compiled model's predictor that runs over control cycles, a chunk at a time, and learns from how far off it is.

Its unknowns are the estimated parameters and the logarithms of the noise (estimators.fit.innovations), hence the Kalman
gain; with them each stretch's initial state. Innovations are weighed by their covariance, which is learned along.

What the first chunks say is said at a start value that may be far off: derivatives, gain and weights there are as
wrong. So chunks are kept for a minute, and when the unknowns have moved far from where these were seen, all are gone
through again with the unknowns held: a Gauss-Newton step of the batch fit. Farther than a reach from there they do not
go before that, since equations that were linear somewhere else lead astray, and a feedback loop at rest leads them on.
Each time is at least a twentieth of free motion later than the one before, so the cost a cycle stays bounded.

Of parameters that are known by their order of magnitude alone (estimators.fit.logarithms) a record often tells products
only. The unknowns are then their logarithms, in which a product is a sum wherever one is, and chunks in between are
seen from where all was seen last. Seen each from another place, they would claim to know every factor: equations of
which each leaves a slightly different direction open leave none open together.

Without a gain it is a simulation, begun anew every second since an unstable plant's errors grow without bound. They are
alike from row to row, so what is known is told from how the gradient varies between chunks. Where hardly anything is
excited, feedback biases it as any output error: the predictor with a gain is the sound one.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from estimators.contract import Estimate
from estimators.disturbance_estimate import DisturbanceEstimate
from estimators.fit.disturbance import Found, is_of_disturbance, of_joints
from estimators.fit.gauss_newton import Minimum
from estimators.fit.innovations import NoiseModel
from estimators.fit.likelihood import FLOOR
from estimators.fit.logarithms import is_known_roughly
from estimators.fit.problem import Problem
from estimators.fit.result import assemble
from estimators.fit.stationary_start import stationary_start
from estimators.recursive.frame_chunks import Chunk, join
from estimators.recursive.gauss_newton import ROUNDING, SLIGHT, RecursiveGaussNewton
from models.compiler.kernel import Memory
from models.expressions import number
from models.parts import Output
from models.segment import Segment

Array = NDArray[np.float64]

GAIN_MOVES = (0.5, 0.5)
"""Typical sizes of a parameter, and natural logarithms of a noise or of how long it lasts, after which the gain is
computed anew."""
FAR, REACH = (0.05, 0.3), (0.5, 0.5)
"""The same after which what is kept is gone through again, and how far from there the unknowns may go before it is."""
SOONEST, USUAL, ROUGH, URGENT = 0.5, 1.2, 1.1, 1.05
"""s of free motion after which this is done at the soonest, and factors to the next time: `ROUGH` where parameters are
known roughly (for all, a live diagnosis named something in 3 of 40 clean records, in place of 1), `URGENT` where the
reach holds the unknowns back."""
KEPT = 64.0
"""s of free motion from which on no chunks are kept any more."""
JOINED = 40
"""Chunks that are gone through in one."""
STALE = 1e-3
"""Share of its weight that the innovations' covariance keeps when all innovations are found anew."""
ABSURD = 30.0
"""Standard deviations that no innovation of a predictor that works has."""
ALIKE = 0.01
"""Share of its noise by which a count may differ from another one that reads exactly like it, as both wheels of a
vehicle that is symmetric to the last bit do: together they say no more than one of them."""
LOGARITHM, OF_NOISE = 0.5, 1.0
"""Typical size of the logarithm of a parameter that is known roughly, and of one that says how long a noise lasts: as
of the logarithm of its size."""
WIDE = 10.0
"""Typical sizes within which a parameter lies of which nothing is known."""


@dataclass(frozen=True, slots=True)
class Seen:
    """What a chunk of n rows was predicted with, and what came of it, for whoever looks further than this model.

    `values` (np,), `gain` (nx, ny); `whitening` (ny, ny) turns an innovation into independent ones of unit variance.
    `residual` (n * ny,) are these; `columns` (n * ny, m) what the unknowns z (nz,), the stretch's initial state and the
    parameters that are held but not exactly known do to the prediction, whitened, per typical size or standard
    deviation. `prior` (m,) is one over their variances. A `count` says that all so far was seen from too far away: this
    is chunk number `place` of as many that all of it comes in again.
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
    """`problem` without data says what is sought; cycles follow each other in `period` s.

    `memory` s is the time constant of forgetting. Without `corrected` it is a simulation. `watch` is shown every chunk
    that was learned from, as it comes and whenever all is gone through again.
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
        # How long a disturbance lasts is known roughly, too, and is no factor of a product that is better known.
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
        self._stretch = slice(len(prior), len(prior) + len(spread))
        self._regression = RecursiveGaussNewton(
            prior,
            np.concatenate((self._inside(self._lower), -widest)),
            np.concatenate((self._inside(self._upper), widest)),
            asked=free,
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
        """Rows that were learned from."""
        self.span = 0.0
        """s of free motion."""
        self.lost = 0
        """Times that the innovations were absurd."""

    def take(self, chunk: Chunk) -> None:
        """The next chunk. One with absurd innovations is left out; the predictor then begins anew."""
        if self._state is None:
            chunk = chunk.as_first()
        latest = self._regression.z
        if self._one_place:  # the solution starts from there again
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
        # Of a noise that hardly matters anything is as likely: where it is seen from matters as little.
        if not far[self._machine].any() and self._regression.side_deviations(self._seen_from) <= SLIGHT:
            far[:] = False
        if self.span >= again_at and far.any():
            moved = self._learn_again()
        self._settled = bool(np.all(moved[self._machine] < 0.99 * self._reach[self._machine]))

    def estimate(self, method: str) -> Estimate:
        """What is known now, under the name `method`."""
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
        """What shakes the vehicle, as of `estimate`."""
        return self._disturbance(self._regression.uncertainty().every) if self._shaken_states else ()

    def _disturbance(self, covariance: Array) -> tuple[DisturbanceEstimate, ...]:
        """What shakes the vehicle; `covariance` (n, n) of the unknowns."""
        if self._noise is None or not self._shaken_states:
            return ()
        sizes = np.concatenate((self._sizes, np.ones(self._noise.size)))
        values, logarithms = self._values, self._regression.z[self._free :]
        found = covariance * np.outer(sizes, sizes)
        return of_joints(Found(self._noise, values, logarithms, found, self._covariance(), self.rows))

    @property
    def _values(self) -> Array:
        """Of all parameters, (np,)."""
        moved = self._regression.z[: self._free]
        rough = self._start * np.exp(np.where(self._roughly, self._logarithm * moved, 0.0))
        common = np.where(self._roughly, rough, self._start + self._scale * moved)
        return self._problem.values(np.clip(common, self._lower, self._upper))

    @property
    def _sizes(self) -> Array:
        """What one of each unknown parameter changes its value by, here, (p,)."""
        values = self._values[list(self._problem.free)]
        return np.where(self._roughly, self._logarithm * values, self._scale)

    def _inside(self, values: Array) -> Array:
        """The unknowns (p,) at `values` (p,) of the estimated parameters."""
        ratio = np.where(self._roughly, values / np.where(self._roughly, self._start, 1.0), 1.0)
        return np.where(self._roughly, np.log(ratio) / self._logarithm, (values - self._start) / self._scale)

    def _predict(self, chunk: Chunk) -> tuple[Array, Array]:
        """Errors of the predictor through `chunk`, (n, ny), and the slopes of what it predicts, (n, ny, active)."""
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
        """What the errors say, weighed by the covariance that is known now. `again` (place, count): it is one
        of all that are kept."""
        if chunk.begins:
            self._prior[self._stretch] = self._start_precision()
            self._regression.begin(self._prior[self._stretch])
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
        """One over the variances (k,) of the next stretch's initial state, in the units of its columns: a disturbance
        begins as it is in the long run."""
        if self._noise is None:
            return np.ones(len(self._problem.spread))
        spread = stationary_start(self._noise, self._values, self._regression.z[self._free :]).spread
        return np.asarray((self._problem.spread / spread) ** 2)

    def _learn_again(self) -> Array:
        """All that is kept, seen from where the unknowns are now; how far they move then, (n,)."""
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
        """The gain at the present unknowns: exact where it was computed last, from there on by its slopes."""
        if self._noise is None:
            return None
        z, free = self._regression.z, self._free
        if self._gain_at is not None:
            moved = z - self._gain_at
            # What has gone as far as its reach has moved just as far, and rounding must not decide.
            if (np.abs(moved) < (1.0 - ROUNDING) * self._gain_moves).all():
                return self._gain + (self._gain_slopes @ moved[self._gain_unknowns]).reshape(self._gain.shape)
        times = tuple(self._problem.free[place] for place in self._shaken)
        found = self._noise.gain_and_slopes(values, z[free:], times, values[list(times)])
        if found is not None:
            self._gain, slopes = found
            slopes[:, : len(times)] *= self._sizes[list(self._shaken)]
            self._gain_slopes, self._gain_at = np.ascontiguousarray(slopes), z
        return self._gain

    def _is_possible(self, error: Array, slopes: Array) -> bool:
        """Whether the predictor still follows the vehicle. If not, the noise may just be more than was thought: it is
        learned, within bounds. From parameters known by their order of magnitude alone nobody expects that at first."""
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
        # What is known roughly may set out far from where it was measured, which is no noise.
        as_it_is = self._noise is not None and not self._one_place
        self._add_squares(error if as_it_is else self._without_start(error, slopes))

    def _add_squares(self, error: Array) -> None:
        kept = self._kept_share(error)
        self._squares = kept * self._squares + error.T @ error
        self._weight = kept * self._weight + len(error)

    def _covariance(self) -> Array:
        """Of an innovation, (ny, ny)."""
        covariance = self._squares / self._weight + self._floor
        return covariance if self._noise else np.diag(np.diagonal(covariance))

    def _whitening(self) -> Array:
        """Turns an innovation into independent ones of unit variance, (ny, ny)."""
        return np.linalg.inv(np.linalg.cholesky(self._covariance()))

    def _without_start(self, error: Array, slopes: Array) -> Array:
        """`error` (n, ny) less what an initial state that is not quite as measured explains."""
        whitening = self._whitening()
        spread = self._others[: self._own.stop - self._own.start]
        own = (whitening @ slopes[:, :, self._own]).reshape(error.size, -1) * spread
        start = np.linalg.solve(own.T @ own + np.eye(own.shape[1]), own.T @ (error @ whitening.T).ravel())
        explained: Array = slopes[:, :, self._own] @ (spread * start)
        return error - explained


def of_noise(problem: Problem) -> NDArray[np.bool_]:
    """Which of the estimated parameters (p,) say how long a noise lasts, and nothing of the machine."""
    times = is_of_disturbance(problem.model)
    return np.array([parameter.name in times for parameter in problem.parameters], dtype=bool)


def _share(output: Output, *, corrected: bool) -> float:
    """Of an output's noise: the standard deviation that is added to its innovations."""
    if corrected and output.noise_known:
        return FLOOR
    return ALIKE if output.counted else 1e-9


def inputs_at(problem: Problem, segment: Segment, row: int, values: Array) -> NDArray[np.int64]:
    """Which sample of each input (nu,) acts at `row`, at parameter `values` (np,)."""
    late = [sum(values[problem.kernel.index(name)] for name in each.delays) for each in problem.model.inputs]
    passed = np.count_nonzero(segment.knots + late < segment.time[row], axis=0)
    return np.asarray(np.maximum(passed - 1, 0))


def measured_state(problem: Problem, measured: Array) -> Array:
    """The state (nx,) as the outputs `measured` (ny,) show it."""
    shown = zip(problem.kernel.outputs, map(float, measured), strict=True)
    known = {**problem.model.values, **dict(shown)}
    states = problem.model.states
    return np.array([number(state.initial, known, f"state {state.name}, initial") for state in states])
