"""What fits say of data that they have not seen: the last of several recordings, or each third of a single one in turn.

A third is judged by fits of the other two. Predictors run through the whole recording, so that they know their state
when the third begins, as an effect with memory asks for; only what they predict inside it counts.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from diagnosis import ahead
from diagnosis.refit import FullFit, full, off_prior
from diagnosis.whitened import whitening
from diagnosis.workspace import Workspace
from estimators.contract import EstimationError, Status
from estimators.gauss_newton import Block, eliminate
from estimators.methods.prediction_error import Fit, result
from estimators.problem import Problem, problem
from estimators.segments import segments
from models.effect import AttachedEffect
from models.model import Model
from telemetry.recording import Recording

Array = NDArray[np.float64]

THIRDS = 3
SETTLING = 0.5
"""s at the beginning of a recording that tell of the start, not of the model."""
BLOCK = 1.0
"""s of held-out data that count as one piece of evidence."""
SURE = 2.0
"""Standard deviations from zero of an amplitude that a part of the data tells. One that does not tell cannot judge."""
NOT_TOLD = (Status.TOO_LITTLE_EXCITATION, Status.UNIDENTIFIABLE)
HORIZON = 0.5
"""s ahead at which held-out errors are told: far enough for a missing force to show."""


@dataclass(frozen=True, slots=True)
class Fold:
    """`seen` is fitted. Of `whole`, the rows from `begin` to `end` (s) are judged; `tried` has these alone."""

    seen: tuple[Recording, ...]
    whole: Recording
    tried: Recording
    begin: float
    end: float


@dataclass(frozen=True, slots=True)
class Unseen:
    """`gain`: rise of the log likelihood; `std` of it; `known`: by how much parameters are nearer to what was known of
    them before, as a logarithm; `closed_percent`: of the error energy HORIZON ahead that exceeds
    the sensors', what is gone, and the standard deviation of that, None where there was none."""

    gain: float
    std: float
    closed_percent: float | None
    closed_std: float | None = None
    known: float = 0.0

    @property
    def stands(self) -> bool:
        """Whether the likelihood rises beyond its own noise, and no error grows beyond its."""
        closes = self.closed_percent is None or self.closed_std is None or self.closed_percent > -self.closed_std
        return closes and self.gain + self.known >= self.std


class UnseenCheck:
    """Judges effects that are added to one model, whose own fits are made once."""

    def __init__(self, base: FullFit, workspace: Workspace) -> None:
        self._base = base
        self._workspace = workspace
        self._few: dict[float, Workspace] = {}
        self._without: dict[float, Fit] = {}

    def of(self, best: FullFit) -> Unseen | None:
        """What fits of a part of the data say of the rest; None where no part tells the effects that `best` adds."""
        there = {each.name for each in self._base.model.effects}
        further = [each for each in best.model.effects if each.name not in there]
        workspace = self._workspace
        try:
            parts = folds(self._base.model, workspace.recordings, workspace.support)
            return judge(parts, lambda part: self._fits(best, further, part), workspace.support)
        except (EstimationError, ArithmeticError):
            return None

    def _fits(self, best: FullFit, further: Sequence[AttachedEffect], part: Fold) -> tuple[Fit, Fit] | None:
        base, workspace = self._base.model, self._workspace
        if part.begin not in self._few:
            # Once each, whatever the number of its places.
            others = tuple({each.effect.name: each.effect for each in workspace.others(base)}.values())
            self._few[part.begin] = Workspace.of(base, part.seen, workspace.support, others)
        few = self._few[part.begin]
        with_it = full(best.model, few, begin=best.fit.end).fit
        told = result(with_it, 0.0).parameters
        sizes = [told[name] for each in further for name in each.amplitudes]
        if not any(each.value is not None and each.std and abs(each.value) > SURE * each.std for each in sizes):
            return None
        # What happens once, at an instant outside the part, is nothing that the part could foretell.
        instants = [
            p.name for each in further for p in each.parameters if p.unit == "s" and p.name not in each.amplitudes
        ]
        if any(told[name].status in NOT_TOLD for name in instants):
            return None
        if part.begin not in self._without:
            self._without[part.begin] = full(base, few, begin=self._base.fit.end).fit
        return self._without[part.begin], with_it


def folds(model: Model, recordings: Sequence[Recording], support: float | None) -> list[Fold]:
    """What to fit and what to judge. Raises DataError where the recordings cannot be used."""
    whole = recordings[-1]
    if len(recordings) > 1:
        return [Fold(tuple(recordings[:-1]), whole, whole, 0.0, float("inf"))]
    rows = np.concatenate([segment.time for segment in segments(model, recordings, support=support)])
    edges = np.quantile(rows, np.linspace(0.0, 1.0, THIRDS + 1))
    edges[-1] = np.inf
    found = []
    for begin, end in zip(edges[:-1].tolist(), edges[1:].tolist(), strict=True):
        inside = (whole.time >= begin) & (whole.time < end)
        found.append(Fold((_only(model, whole, ~inside),), whole, _only(model, whole, inside), begin, end))
    return found


def judge(
    parts: Sequence[Fold], fits: Callable[[Fold], tuple[Fit, Fit] | None], support: float | None
) -> Unseen | None:
    """What the second of two fits says of unseen data, against the first; None where no part has such fits.

    Raises ArithmeticError, EstimationError.
    """
    gains: list[Array] = []
    energies: list[Array] = []
    known: list[float] = []
    for part in parts:
        found = fits(part)
        if found is None:
            continue
        without, with_it = found
        gains.append(_log_density(with_it, part, support) - _log_density(without, part, support))
        known.append(off_prior(without) - off_prior(with_it))
        energies.append(_energies(without, with_it, part.tried, support))
    if not gains:
        return None
    differences = np.concatenate(gains)
    squares = np.concatenate(energies)
    before, after = np.mean(squares, axis=0)
    spread = float(np.std(squares[:, 0] - squares[:, 1], ddof=1) / np.sqrt(len(squares)))
    return Unseen(
        gain=float(np.sum(differences)),
        std=float(np.sqrt(len(differences)) * np.std(differences, ddof=1)),
        closed_percent=float(100.0 * (before - after) / (before - 1.0)) if before > 1.0 else None,
        closed_std=100.0 * spread / float(before - 1.0) if before > 1.0 else None,
        known=float(np.mean(known)),
    )


def _energies(one: Fit, other: Fit, recording: Recording, support: float | None) -> Array:
    """Error energies HORIZON ahead over that of the sensors' noise, under `one` and under `other`, (m, 2)."""
    there = ahead.on(other, problem(other.problem.model, [recording], support=support))
    floor = ahead.sensor_floors(there, (HORIZON,))[0]
    before = ahead.on(one, problem(one.problem.model, [recording], support=support))
    squares = [np.mean((ahead.errors(each, (HORIZON,))[0] / floor) ** 2, axis=1) for each in (before, there)]
    both = np.stack(squares, axis=1)
    return np.asarray(both[np.isfinite(both).all(axis=1)])


def _log_density(fitted: Fit, part: Fold, support: float | None) -> Array:
    """Of the judged rows, by blocks of a second."""
    seen = fitted.problem
    task = problem(seen.model, [part.whole], support=support)
    task = replace(task, substeps=max(task.substeps, seen.substeps))
    outputs = len(task.kernel.outputs)
    _, logarithm = np.linalg.slogdet(fitted.covariance)
    found = []
    for segment, residual in zip(task.segments, _innovations(fitted, task), strict=True):
        each = residual[: len(segment) * outputs].reshape(-1, outputs)
        density = -0.5 * np.sum(each**2, axis=1) - 0.5 * logarithm
        begin = max(part.begin, float(segment.time[0]) + SETTLING)
        judged = (segment.time >= begin) & (segment.time < part.end)
        number = ((segment.time - begin) / BLOCK).astype(np.int64)
        found.append(np.bincount(number[judged], weights=density[judged]))
    return np.concatenate(found)


def _innovations(fitted: Fit, task: Problem) -> list[Array]:
    """Whitened, by stretch, with the initial state of each fitted."""
    weights = whitening(fitted)
    common = fitted.minimum.common[: len(fitted.problem.free)]
    own = [part.copy() for part in task.own_start]
    blocks: list[Block] = []
    for _ in range(2):
        found = task.evaluate(common, own, weights=weights, gain=fitted.gain)
        if found is None:
            raise ArithmeticError("the model runs away on data that it was not fitted to")
        blocks = found
        own = [
            part - np.linalg.lstsq(block.own, block.residual, rcond=None)[0]
            for part, block in zip(own, blocks, strict=True)
        ]
    return [eliminate(block)[0] for block in blocks]


def _only(model: Model, recording: Recording, kept: NDArray[np.bool_]) -> Recording:
    """`recording` with the measured outputs known where `kept` (n,) alone; time goes on counting from its first row."""
    hidden = {each.name: np.where(kept, recording[each.name], np.nan) for each in model.outputs}
    return replace(recording, values={**recording.values, **hidden})
