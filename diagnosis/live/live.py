"""Which effect a model lacks, while the vehicle runs: the score test of all effects along with the recursion.

The recursive prediction error method gives, chunk by chunk, innovations and their derivatives with respect to its
unknowns. A second kernel, of the model with every candidate attached at amplitude zero, runs along with the same
parameters and the same gain: it gives the derivatives with respect to the amplitude of each effect. Every second or two
`diagnosis.live.odds` computes the odds of each effect against none, for any onset. An effect whose odds chance does not
explain is named (`diagnosis.live.naming`), together with those that are not distinguishable from it yet; it is then
taken as given, and the next one is searched for.

Each effect is tested in one shape only (`upright diagnose` tries several and refits each), except for the frequency of
a disturbance, which is followed. An amplitude is one linear step from a model whose noise had to absorb the effect: up
to 70 % too large was seen. So the result is a first answer, which the diagnosis of the recording confirms.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from upright.diagnosis.live.line import LONGEST, LineFinder
from upright.diagnosis.live.naming import TOO_LITTLE, Gathered, LiveResult
from upright.diagnosis.prepare.candidates import Candidate, candidates_for
from upright.diagnosis.prepare.workspace import attached
from upright.estimators.fit.problem import Problem, steps_within
from upright.estimators.fit.problem import at_rest as moment_at_rest
from upright.estimators.recursive.frame_chunks import Chunk, join
from upright.estimators.recursive.prediction_error import (
    CHUNK,
    RecursivePredictionError,
    at_rest,
    known_as,
    with_recursive_disturbances,
)
from upright.estimators.recursive.predictor import Seen, inputs_at, measured_state, of_noise
from upright.models.compiler.kernel import Kernel, Memory, Progress, compile_model
from upright.models.effect import Effect, Role
from upright.models.effects.catalogue import CATALOGUE, find
from upright.models.model import Model
from upright.models.parts import ModelError
from upright.telemetry.channels import ChannelTable
from upright.telemetry.samples import Frame

Array = NDArray[np.float64]

JOINED = 4
"""Chunks that are processed at once at first; later as many as a second has."""
FINEST = 8
"""Steps per sample, at most."""
FAR = (0.05, 0.6)
"""Change of a parameter in typical sizes, and of a noise or its correlation time in natural logarithms, after which all
data are processed again with the recursion. The recursion itself repeats them after half of these logarithms, for its
gain, which does not distinguish effects any better: hardly anything is known of some noises, so that they change for
minutes."""
NEAR = 0.25
"""Cycles by which a line may drift within the data gathered of it, or by which its frequency is uncertain over the data
that it was estimated from."""
COUNTS = 1
"""Counts by which a counted output has to move in a chunk for the chunk to be used: its error is then as good as noise.
If the output hardly moves, the error stays for seconds, like a torque or friction."""


def _line_of(candidate: Candidate) -> tuple[str, str] | None:
    """The name of an effect that is a line in a spectrum, and the parameter that is its frequency; None for others."""
    frequencies = candidate.attached.of_role(Role.FREQUENCY)
    return (candidate.name, frequencies[0]) if frequencies and candidate.effect.follows_time else None


class LiveDiagnosis:
    """The effects that `model` lacks, named while cycles come in; `estimator` is the recursion that it watches.

    Effects that `model` has already are searched for too, as they are in its recursion but not in the vehicle's own
    equations. `effects` are the candidates, the whole catalogue by default. The other arguments are those of
    estimators.recursive.prediction_error.RecursivePredictionError, with its errors. Creating an instance compiles two
    models.
    """

    method = "live_diagnosis"

    def __init__(
        self,
        model: Model,
        *,
        parameters: Mapping[str, float] | None = None,
        deviations: Mapping[str, float] | None = None,
        support: float | None = None,
        channels: ChannelTable,
        effects: Sequence[str | Effect] | None = None,
        progress: Progress | None = None,
    ) -> None:
        model = with_recursive_disturbances(known_as(model, parameters, deviations))
        self.estimator = RecursivePredictionError(
            model,
            support=support,
            channels=channels,
            progress=progress,
            watch=self._see,
        )
        chosen = [find(each) if isinstance(each, str) else each for each in effects or CATALOGUE]
        # An effect that sets in is found as the effect it is from then on; a stiff one cannot run along with the
        # others.
        found, self.left_out = candidates_for(model, (), [each for each in chosen if not (each.onset_of or each.stiff)])
        wide = attached(model, found)
        if wide.inputs != model.inputs:
            what = "one of the effects needs an input that the model does not have"
            raise ModelError(f"model {model.name}", what, remedy="name the effects to look for.")
        self._base = at_rest(model, 0.01, progress)
        self._candidates = tuple(found)
        amplitudes = [name for each in found for name in each.amplitudes]
        self._wide = kernel = compile_model(wide, neutral=amplitudes, progress=progress)
        self._defaults = kernel.vector(dict.fromkeys(amplitudes, 0.0))
        self._usual = substeps(kernel, self._defaults, self._base, 0.01)
        self._shared = np.array([kernel.index(parameter.name) for parameter in model.parameters])
        self._lined = next(filter(None, map(_line_of, found)), None)
        self._line_place = None if self._lined is None else kernel.index(self._lined[1])
        self._active = tuple(map(kernel.index, amplitudes))
        self._rooms: dict[str, Array] = {}
        self.reset()

    def reset(self) -> None:
        """Forget all cycles."""
        self.estimator.reset()
        self._memory: Memory | None = None
        self._gathered: Gathered | None = None
        self._seen_from: Array = np.zeros(0)
        self._far: Array = np.zeros(0)
        self._going_on = False
        self._began = math.inf
        self._waiting: list[Seen] = []
        self._waits = 0
        self._substeps = self._usual
        self._neutral = self._defaults.copy()
        self._line: LineFinder | None = None
        self._line_since = 0
        self._shapes: dict[str, tuple[float, float, str]] = {}
        self._failure = ""
        self._result = TOO_LITTLE

    def update(self, frame: Frame) -> None:
        """Take one control cycle, through the recursion."""
        self.estimator.update(frame)

    def result(self) -> LiveResult:
        """What is missing, as far as the data show it."""
        return LiveResult((), {}, 0, self._failure) if self._failure else self._result

    def _see(self, seen: Seen) -> None:
        """A chunk of the recursion. If anything fails here, the recursion still goes on."""
        if self._failure:
            return
        try:
            if seen.count and self._goes_on(seen):
                return
            if seen.chunk.begins or (seen.count and seen.place == 0):
                # Another initial state, which is not in what was gathered.
                self._waiting.clear()
                self._waits = 0
                self._memory = self._gathered = None
            if not seen.chunk.settled:
                return
            self._waiting.append(seen)
            self._waits += len(seen.residual)
            if seen.count or self._is_due():
                self._take()
        except (ArithmeticError, ValueError, np.linalg.LinAlgError) as error:
            self._failure = f"the live diagnosis stopped: {type(error).__name__}: {error}"

    def _is_due(self) -> bool:
        """Whether the waiting chunks complete a second, which is when they are needed."""
        if self._gathered is None or self._line is None:
            return len(self._waiting) == JOINED
        rows = self._waits // len(self._base.kernel.outputs)
        return self._gathered.completes(rows * self._line.period, CHUNK * self._line.period)

    def _goes_on(self, seen: Seen) -> bool:
        """Whether what was gathered stays as it is while the recursion repeats all data, because the unknowns are still
        near the values at which it was gathered."""
        if seen.place == 0:
            known = self._gathered is not None
            self._going_on = known and bool((np.abs(seen.z - self._seen_from) <= self._far).all())
        return self._going_on

    def _take(self) -> None:
        """Process the waiting chunks at once."""
        waiting, self._waiting, self._waits = self._waiting, [], 0
        if not waiting:
            return
        last = waiting[-1]
        (chunk,) = join([each.chunk for each in waiting], len(waiting))
        effects = self._effects(chunk, last)
        if effects is None:
            return
        outputs = len(self._base.kernel.outputs)
        if self._gathered is None:
            began = float(chunk.segment.time[chunk.first])
            self._began = min(self._began, began)
            whole = began <= self._began
            self._gathered = Gathered.of(self._base, self._candidates, last, whole=whole)
            self._seen_from = last.z
            noisy = np.concatenate((of_noise(self._base), np.ones(len(last.z) - len(self._base.free), dtype=bool)))
            self._far = np.where(noisy, FAR[1], FAR[0])
            self._line = LineFinder(float(np.median(np.diff(chunk.segment.time))))
            self._line_since = 0
        assert self._line is not None
        # Linearised about one point, so that it does not matter that the recursion moves on meanwhile.
        gathered, about, order = self._gathered, self._gathered.about, self._gathered.order
        columns = self._room("columns", len(effects), len(order) + len(self._active) + 1)
        first = 0
        for each in waiting:
            self._line.add(each.residual.reshape(-1, outputs))
            rows = slice(first, first + len(each.residual))
            columns[rows, : len(order)] = each.columns[:, order]
            columns[rows, -1] = each.residual + each.columns[:, : len(about)] @ (each.z - about)
            first = rows.stop
        columns[:, len(order) : -1] = effects
        whole = gathered.add(*self._moving(columns, chunk)) and last.place + 1 >= last.count
        if whole and (last.count or gathered.is_due()):
            tries = {} if self._lined is None else {self._lined[0]: self._line.bins}
            found = gathered.look(self._shapes, tries)
            self._result = replace(found, disturbance=self.estimator.disturbance())
            self._follow_line()

    def _moving(self, columns: Array, chunk: Chunk) -> tuple[Array, list[tuple[slice, float, float]]]:
        """The `columns` of a chunk and its parts, without those parts in which a counted output hardly moves."""
        outputs = self._base.model.outputs
        found = list(parts(chunk, len(outputs)))
        # The error is uniform within a count, a noise of the count over the root of 12.
        counts = {i: each.noise * 12**0.5 for i, each in enumerate(outputs) if each.counted and not each.noise_known}
        if not counts:
            return columns, found
        measured = chunk.segment.measured[chunk.rows]
        kept, moving, first = [], [], 0
        for numbers, begin, span in found:
            rows = measured[numbers.start // len(outputs) : numbers.stop // len(outputs)]
            if all(np.ptp(rows[:, place]) >= COUNTS * count for place, count in counts.items()):
                size = numbers.stop - numbers.start
                kept.append(columns[numbers])
                moving.append((slice(first, first + size), begin, span))
                first += size
        return (columns if len(kept) == len(found) else np.concatenate([columns[:0], *kept])), moving

    def _follow_line(self) -> None:
        """Search for the disturbance of one frequency at the line of the innovations, in the data from now on.

        Data that are repeated were already there when the line was picked, so it has the price of all lines that could
        have been picked.
        """
        if self._lined is None or self._line_place is None or self._gathered is None or self._line is None:
            return
        found = self._line.frequency()
        if found is None:
            return
        frequency, span = found
        seconds = self._gathered.products.seconds
        followed = min(max(1.0, seconds - self._line_since), LONGEST)
        if abs(frequency - float(self._neutral[self._line_place])) * followed > NEAR:
            self._neutral[self._line_place] = frequency
            self._line_since = seconds
            self._gathered.forget(self._lined[0])
        self._shapes[self._lined[1]] = (frequency, NEAR / span, "Hz")

    def _effects(self, chunk: Chunk, seen: Seen) -> Array | None:
        """Derivatives of a chunk's innovations with respect to the candidates' amplitudes, (n, m), at the last `seen`.

        None if an effect's own motion is too fast for the steps: the next chunk is integrated in finer ones."""
        kernel, segment, size = self._wide, chunk.segment, len(self._active)
        rows = chunk.rows
        values = self._neutral.copy()
        values[self._shared] = seen.values
        if self._memory is None or chunk.begins:
            chunk = chunk.as_first()
            initial = np.zeros(len(kernel.states))
            initial[: len(self._base.kernel.states)] = measured_state(self._base, segment.measured[chunk.first])
            self._memory = kernel.memory(initial, self._active)
        else:
            self._memory.pointer[:] = inputs_at(self._base, segment, chunk.first, seen.values)
        gain = np.zeros((len(kernel.states), len(kernel.outputs)))
        if seen.gain is not None:
            gain[: len(seen.gain)] = seen.gain
        shape = segment.measured.shape
        predicted, slopes = self._room("predicted", *shape), self._room("slopes", *shape, size)
        kernel.proceed(
            segment,
            values,
            self._memory,
            gain,
            self._active,
            predicted,
            slopes,
            first=chunk.first,
            last=chunk.last,
            substeps=self._substeps,
            skip=not chunk.begins,
        )
        effects: Array = np.matmul(seen.whitening, slopes[rows])
        if np.isfinite(effects).all():
            return effects.reshape(-1, size)
        if self._substeps >= FINEST:
            raise ArithmeticError("an effect's derivative is not finite")
        self._substeps, self._memory = 2 * self._substeps, None
        return None

    def _room(self, purpose: str, *shape: int) -> Array:
        """An array that is used again and again: allocating a large one each time costs as much as using it."""
        size = math.prod(shape)
        if len(self._rooms.get(purpose, ())) < size:
            self._rooms[purpose] = np.empty(size)
        return self._rooms[purpose][:size].reshape(shape)


def substeps(kernel: Kernel, values: Array, base: Problem, period: float) -> int:
    """Steps per sample of `period` s that the fastest motion at rest needs, by differences, as the kernel has no
    derivatives of states on which no output depends."""
    short, little = 1e-6, 1e-4
    rest = moment_at_rest(kernel, base.segments, short)
    moved = little * np.concatenate((np.zeros((1, len(kernel.states))), np.eye(len(kernel.states))))
    later = np.array([kernel.run(rest, values, initial).final for initial in moved]) - moved
    matrix = (later[1:] - later[0]).T / (short * little)
    return steps_within(period, matrix)


def parts(chunk: Chunk, outputs: int) -> Iterator[tuple[slice, float, float]]:
    """A long chunk in parts of the usual length: which of its numbers (samples x outputs), begin and duration of
    each."""
    time = chunk.segment.time[chunk.rows].tolist()
    for first in range(0, len(time), CHUNK):
        last = min(first + CHUNK, len(time))
        span = (time[last - 1] - time[first]) * (last - first) / max(last - first - 1, 1)
        yield slice(first * outputs, last * outputs), time[first], span
