"""Which effect a model lacks, while the vehicle runs: the score test of all effects along with the recursion.

The recursive prediction error method gives, chunk by chunk, innovations and what its unknowns do to them. A second
kernel, of the model with every candidate attached at amplitude zero, runs along with the same parameters and the same
gain: it says what a little of each effect would do. `diagnosis.onset` looks for the effect and the second since which
it acts, once a second. One that stands out from all that was looked at gets a name (`diagnosis.live_naming`); it is
then taken for granted, and the next one is looked for.

It sees each effect at one shape only (`upright diagnose` tries several and refits each), but for the frequency of a
disturbance, which is followed. A size is one linear step
from a model whose noise had to stand in for the effect: up to 70 % too large was seen. So what it says is a first
answer, which the diagnosis of the recording confirms.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from diagnosis.candidates import candidates_for
from diagnosis.line import LineFinder
from diagnosis.live_naming import SUDDEN, TOO_LITTLE, Gathered, LiveResult
from diagnosis.workspace import attached
from estimators.frame_chunks import Chunk, join
from estimators.recursive_prediction_error import CHUNK, RecursivePredictionError, at_rest
from estimators.recursive_predictor import Seen, inputs_at, measured_state
from models.effect import Effect
from models.effects import CATALOGUE
from models.kernel import Memory, Progress
from models.model import Model, ModelError
from telemetry.channels import MONOCAB, ChannelTable
from telemetry.samples import Frame

Array = NDArray[np.float64]

JOINED = 4
"""Chunks that are gone through in one."""
FINEST = 8
"""Steps a row, at most."""
LINE = "periodic_disturbance"
"""The effect whose frequency is followed."""
NEAR = 0.25
"""Of the width of a line, by which its frequency may be off."""
UNSEEN = ("backlash", "sensor_lag")
"""Effects whose own motion is too fast to be followed along with all others."""


class LiveDiagnosis:
    """The effects that `model` lacks, named while cycles come in; `estimator` is the recursion that it looks over.

    What `model` has of effects already is looked for too, as that is in its recursion but not in the vehicle's own
    equations. `effects` are the candidates, the whole catalogue by default. The other arguments are those of
    estimators.recursive_prediction_error.RecursivePredictionError, with its errors. To make one compiles two models.
    """

    method = "live_diagnosis"

    def __init__(
        self,
        model: Model,
        *,
        parameters: Mapping[str, float] | None = None,
        deviations: Mapping[str, float] | None = None,
        support: float | None = None,
        channels: ChannelTable = MONOCAB,
        effects: Sequence[str | Effect] | None = None,
        progress: Progress | None = None,
    ) -> None:
        self.estimator = RecursivePredictionError(
            model,
            parameters=parameters,
            deviations=deviations,
            support=support,
            channels=channels,
            progress=progress,
            watch=self._see,
        )
        names = [each if isinstance(each, str) else each.name for each in effects or CATALOGUE]
        chosen = [
            each
            for each, name in zip(effects or CATALOGUE, names, strict=True)
            if name not in (*SUDDEN.values(), *UNSEEN)
        ]
        found, self.left_out = candidates_for(model, (), chosen)
        wide = attached(model, found)
        if wide.inputs != model.inputs:
            raise ModelError(f"model {model.name}", "an effect needs a further input", remedy="name the effects.")
        self._base = at_rest(model, 0.01, progress)
        self._wide = at_rest(wide, 0.01, progress)
        self._candidates = tuple(found)
        kernel = self._wide.kernel
        self._defaults = kernel.vector({name: 0.0 for each in found for name in each.amplitudes})
        self._shared = np.array([kernel.index(parameter.name) for parameter in model.parameters])
        line = f"{LINE}.frequency"
        self._line_place = kernel.index(line) if line in kernel.parameters else None
        self._active = tuple(kernel.index(name) for each in found for name in each.amplitudes)
        self.reset()

    def reset(self) -> None:
        """Forget all cycles."""
        self.estimator.reset()
        self._memory: Memory | None = None
        self._gathered: Gathered | None = None
        self._waiting: list[Seen] = []
        self._substeps = self._wide.substeps
        self._neutral = self._defaults.copy()
        self._line: LineFinder | None = None
        self._shapes: dict[str, tuple[float, float, str]] = {}
        self._failure = ""
        self._result = TOO_LITTLE

    def update(self, frame: Frame) -> None:
        """Take one control cycle, through the recursion."""
        self.estimator.update(frame)

    def result(self) -> LiveResult:
        """What is missing, as far as it shows."""
        return LiveResult((), {}, 0, self._failure) if self._failure else self._result

    def _see(self, seen: Seen) -> None:
        """A chunk of the recursion. Whatever goes wrong here, the recursion goes on."""
        if self._failure:
            return
        try:
            if seen.chunk.begins or (seen.count and seen.place == 0):
                # Another initial state, which what was gathered knows nothing of.
                self._waiting.clear()
                self._memory = self._gathered = None
            self._waiting.append(seen)
            if seen.count or len(self._waiting) == JOINED:
                self._take()
        except (ArithmeticError, ValueError, np.linalg.LinAlgError) as error:
            self._failure = f"the live diagnosis ended: {type(error).__name__}: {error}"

    def _take(self) -> None:
        """What waits, in one."""
        waiting, self._waiting = self._waiting, []
        if not waiting:
            return
        last = waiting[-1]
        (chunk,) = join([each.chunk for each in waiting], JOINED)
        effects = self._effects(chunk, last)
        if effects is None:
            return
        outputs = len(self._base.kernel.outputs)
        if self._gathered is None:
            self._gathered = Gathered.of(self._base, self._candidates, last)
            self._line = LineFinder(float(np.median(np.diff(chunk.segment.time))))
        assert self._line is not None
        for each in waiting:
            self._line.add(each.residual.reshape(-1, outputs))
        # As seen from one place, so that it does not matter that the recursion moves on meanwhile.
        about = self._gathered.about
        target = [each.residual + each.columns[:, : len(about)] @ (each.z - about) for each in waiting]
        nuisances = np.concatenate([each.columns for each in waiting])
        columns = np.column_stack((nuisances, effects[len(effects) - len(nuisances) :], np.concatenate(target)))
        for rows, begin, span in parts(chunk, outputs):
            if self._gathered.add(columns[rows], begin, span) and last.place + 1 >= last.count:
                self._result = self._gathered.look(self._shapes, {LINE: self._line.bins})
                self._follow_line()

    def _follow_line(self) -> None:
        """The disturbance of one frequency is looked for where innovations have a line, in what comes from now on.

        Data that are gone through again were there when it was picked: so it has the price of all that could have been.
        """
        if self._line_place is None or self._gathered is None or self._line is None:
            return
        found, width = self._line.frequency(), NEAR / max(self._line.span, 1.0)
        if found is not None and abs(found - float(self._neutral[self._line_place])) > width:
            self._neutral[self._line_place] = found
            self._shapes[f"{LINE}.frequency"] = (found, width, "Hz")
            self._gathered.forget(LINE)

    def _effects(self, chunk: Chunk, seen: Seen) -> Array | None:
        """What the candidates do to a chunk's innovations, (n, m), with what was `seen` last.

        None where an effect's own motion is too fast for the steps: the next chunk is gone through in finer ones."""
        kernel, segment, size = self._wide.kernel, chunk.segment, len(self._active)
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
        predicted, slopes = np.empty_like(segment.measured), np.empty((*segment.measured.shape, size))
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
        effects: Array = (seen.whitening @ slopes[chunk.rows]).reshape(-1, size)
        if np.isfinite(effects).all():
            return effects
        if self._substeps >= FINEST:
            raise ArithmeticError("an effect's derivative is not finite")
        self._substeps, self._memory = 2 * self._substeps, None
        return None


def parts(chunk: Chunk, outputs: int) -> Iterator[tuple[slice, float, float]]:
    """A long chunk in parts of the usual length: which of its numbers (rows x outputs), when it begins and how long."""
    time = chunk.segment.time[chunk.rows]
    for first in range(0, len(time), CHUNK):
        last = min(first + CHUNK, len(time))
        span = float(time[last - 1] - time[first]) * (last - first) / max(last - first - 1, 1)
        yield slice(first * outputs, last * outputs), float(time[first]), span
