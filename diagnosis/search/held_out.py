"""Checks fits on data that they have not used: the last of several recordings, or each third of a single one in turn.

A third is every third of PIECES x THIRDS pieces, and is judged by fits of the other two. Predictors run through the
whole recording, so that they know their state when a piece begins, as an effect with memory requires; only their
predictions inside it count. If the expected rise of the log-likelihood is smaller than its standard deviation, no
statement is made. A fold in which the effect is not identifiable does not take part.

Errors have a normal distribution with tails (Box, Tiao, "A Bayesian approach to some outlier problems", 1968): a
single sample must not outweigh all others. If parts collide, an impact that is predicted one sample early is an error
of dozens of standard deviations: with tails, for the right effect -3,000 ± 4,000 became 1,840 ± 610.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from upright.diagnosis.evidence import SIGNIFICANT, is_significant
from upright.diagnosis.fits.refit import FullFit, off_prior, remembered
from upright.diagnosis.gates import HeldOut
from upright.diagnosis.prediction import ahead
from upright.diagnosis.prepare.pieces import Pieces, hidden, inside
from upright.diagnosis.prepare.workspace import Workspace
from upright.diagnosis.score.whitened import whitening
from upright.diagnosis.side_by_side import side_by_side
from upright.diagnosis.trial import FAILURES
from upright.estimators.contract import Status
from upright.estimators.data.segments import segments
from upright.estimators.data.time_scale import horizon, time_scale
from upright.estimators.fit.gauss_newton import Block, eliminate
from upright.estimators.fit.innovations import NoiseModel
from upright.estimators.fit.likelihood import Likelihood, Seen
from upright.estimators.fit.maximum_likelihood import Fit
from upright.estimators.fit.problem import Problem, problem
from upright.estimators.fit.random.disturbance import SHOWN
from upright.estimators.fit.result import inverse
from upright.estimators.methods.prediction_error import result
from upright.models.effect import AttachedEffect, Role
from upright.models.model import Model
from upright.telemetry.recording import Recording

Array = NDArray[np.float64]

FOLDS = "folds"
"""Key of the folds in a workspace's memory."""
THIRDS = 3
PIECES = 2
"""Pieces of each third: a phenomenon at only one end of the recording is then both in fits and in checks. With six, of
2 s each, a constant torque of 3 N m was confounded with the initial states of the segments."""
SETTLING = 1.25
"""Time scales (estimators.data.time_scale) at the beginning of a recording that depend on its initial state, not on the
model: 0.5 s of the MONOCAB."""
BLOCK = 2.5
"""Time scales of held-out data that count as one independent piece of evidence."""
HALVINGS = 8
"""Bisections on the way to the stated noise: how large a noise may be is found to a 256th of it."""
NOT_IDENTIFIED = (Status.TOO_LITTLE_EXCITATION, Status.UNIDENTIFIABLE)
TAILS = 1e-3
"""Share of the errors that impacts, blows or a sensor's outliers cause, and"""
WIDER = 10.0
"""the factor by which these are wider."""


@dataclass(frozen=True, slots=True)
class Fold:
    """`seen` is fitted. Of `whole`, the samples in `pieces` are judged."""

    seen: Workspace
    whole: Recording
    pieces: Pieces

    def judges(self, time: Array) -> NDArray[np.bool_]:
        """Which of the samples at `time` (n,) are judged."""
        return inside(time, self.pieces)


def held_out(best: FullFit, base: FullFit, workspace: Workspace) -> HeldOut | None:
    """Result of fits of a part of the data on the rest, with the effects that `best` has beyond `base` and without;
    None if these are identifiable in no part."""
    there = {each.name for each in base.model.effects}
    further = [each for each in best.model.effects if each.name not in there]
    amplitudes = {name for each in further for name in each.amplitudes}
    try:
        parts = _folds(base.model, workspace)
        return judge(parts, lambda part: _fits(best, base, further, part), amplitudes, workspace.support)
    except FAILURES:
        return None


def _fits(best: FullFit, base: FullFit, further: Sequence[AttachedEffect], part: Fold) -> tuple[Fit, Fit] | None:
    """The fits of a part without and with the `further` effects of `best`; None if these are not identifiable in the
    part."""
    with_it = with_possible_noise(remembered(best.model, part.seen, begin=best.fit.end).fit)
    estimates = result(with_it, 0.0).parameters
    sizes = [estimates[name] for each in further for name in each.amplitudes]
    if not any(map(is_significant, sizes)):
        return None
    # A single event outside the part cannot be predicted from the part.
    times = [name for each in further for name in each.of_role(Role.INSTANT, Role.DURATION)]
    if any(estimates[name].status in NOT_IDENTIFIED for name in times):
        return None
    return with_possible_noise(remembered(base.model, part.seen, begin=base.fit.end).fit), with_it


def with_possible_noise(fitted: Fit) -> Fit:
    """`fitted` with the noises that do not show enlarged as far as its data allow, by SIGNIFICANT standard deviations
    of a likelihood ratio, but no larger than they are stated.

    Data never exclude noise altogether. A predictor without noise corrects nothing: it is a simulation, in which the
    errors of the parameters accumulate to thousands of standard deviations.
    """
    noise, size = NoiseModel.of(fitted.problem), len(fitted.problem.free)
    logarithms = fitted.minimum.common[size:]
    deviations = np.sqrt(np.diag(inverse(fitted.minimum.information)))[size:]
    least = (deviations > SHOWN) & (logarithms < 0.0)
    if not least.any():
        return fitted
    likelihood = Likelihood(fitted.problem, noise, fitted.minimum.common, fitted.prior).held(fitted.minimum.common)

    def seen(share: float) -> Seen | None:
        """The likelihood with the noises that do not show moved by `share` of the way to what is stated."""
        return likelihood.of_data(np.where(least, (1.0 - share) * logarithms, logarithms), fitted.minimum.own)

    ended = seen(0.0)
    if ended is None:
        return fitted

    def within(found: Seen | None) -> bool:
        return found is not None and found.cost <= ended.cost + 0.5 * SIGNIFICANT**2

    low, high = (1.0, 1.0) if within(seen(1.0)) else (0.0, 1.0)
    for _ in range(HALVINGS if high > low else 0):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if within(seen(middle)) else (low, middle)
    larger = seen(low)
    return fitted if larger is None else replace(fitted, gain=larger.gain, covariance=larger.covariance)


def _folds(model: Model, workspace: Workspace) -> list[Fold]:
    """The folds, made once. Raises DataError if the recordings cannot be used."""
    found: list[Fold] | None = workspace.memory.get(FOLDS)
    if found is None:
        found = workspace.memory[FOLDS] = _cut(model, workspace)
    return [replace(each, seen=replace(each.seen, budget=workspace.budget)) for each in found]


def _cut(model: Model, workspace: Workspace) -> list[Fold]:
    recordings, support = workspace.recordings, workspace.support
    # Each effect once, whatever the number of its places.
    effects = tuple({each.effect.name: each.effect for each in workspace.others(model)}.values())
    whole = recordings[-1]
    if len(recordings) > 1:
        seen = Workspace.of(model, recordings[:-1], support, effects)
        return [Fold(seen, whole, ((0.0, float("inf")),))]
    rows = np.concatenate([segment.time for segment in segments(model, recordings, support=support)])
    edges = np.quantile(rows, np.linspace(0.0, 1.0, THIRDS * PIECES + 1))
    edges[-1] = np.inf
    every = list(pairwise(edges.tolist()))
    found = []
    for third in range(THIRDS):
        pieces = tuple(every[third::THIRDS])
        found.append(Fold(Workspace.of(model, [hidden(model, whole, pieces)], support, effects), whole, pieces))
    return found


def judge(
    parts: Sequence[Fold],
    fits: Callable[[Fold], tuple[Fit, Fit] | None],
    amplitudes: Collection[str],
    support: float | None,
) -> HeldOut | None:
    """Result of the second of two fits on held-out data, compared with the first; None if no part has such fits, or if
    the expected rise of the log-likelihood by its `amplitudes` is smaller than its standard deviation.

    Raises ArithmeticError, EstimationError.
    """
    rises: list[Array] = []
    energies: list[Array] = []
    known: list[float] = []
    predicted: list[Array] = []
    impacts = False
    for part, found in zip(parts, side_by_side(fits, parts), strict=True):
        if found is None:
            continue
        without, with_it = found
        impacts = any(each.effect.impacts for each in with_it.problem.model.effects)
        rise = _expected_rise(with_it, amplitudes, part, support)
        if 2.0 * np.sum(rise) < SIGNIFICANT**2:
            continue
        predicted.append(rise)
        rises.append(_log_density(with_it, part, support) - _log_density(without, part, support))
        known.append(off_prior(without) - off_prior(with_it))
        energies.append(_energies(without, with_it, part, support))
    if not rises:
        return None
    differences, expected = np.concatenate(rises), np.concatenate(predicted)
    # A rise that was expected is not noise, however short the time in which the effect shows.
    share = float(np.clip(np.sum(differences) / np.sum(expected), 0.0, 1.0))
    noise = float(np.linalg.norm(differences - share * expected))
    if np.sum(expected) < noise:
        return None
    squares = np.concatenate(energies)
    before, after, apart = np.mean(squares, axis=0)
    spread = float(np.std(squares[:, 0] - squares[:, 1], ddof=1) / np.sqrt(len(squares)))
    return HeldOut(
        gain=float(np.sum(differences)),
        std=noise,
        closed_percent=float(100.0 * (before - after) / (before - 1.0)) if before > 1.0 else None,
        closed_std=100.0 * spread / float(before - 1.0) if before > 1.0 else None,
        closing_percent=float(100.0 * apart / (before - 1.0)) if before > 1.0 else None,
        known=float(np.mean(known)),
        impacts=impacts,
    )


def _energies(one: Fit, other: Fit, part: Fold, support: float | None) -> Array:
    """Error energies a horizon ahead over that of the sensors' noise, under `one`, under `other`, and of the difference
    of their predictions, (m, 3)."""
    there = ahead.on(other, problem(other.problem.model, [part.whole], support=support))
    reach = horizon(there.problem.model, there.problem.segments)
    floor = ahead.sensor_floors(there, (reach,))[0]
    before = ahead.on(one, problem(one.problem.model, [part.whole], support=support))
    errors, less = (ahead.errors(each, (reach,))[0] / floor for each in (before, there))
    squares = np.stack([np.mean(each**2, axis=1) for each in (errors, less, errors - less)], axis=1)
    judged = squares[part.judges(ahead.times(there, reach))]
    return np.asarray(judged[np.isfinite(judged).all(axis=1)])


def loss(white: Array) -> Array:
    """Negative log-likelihood of each sample of whitened errors `white` (n, outputs), less that of no error, nats (n,).

    Errors have a normal distribution that is contaminated by a wider one: (1 - TAILS) N(0, 1) + TAILS N(0, WIDER^2)
    (Box and Tiao).
    """
    normal, odds = 0.5 * white**2, TAILS / WIDER / (1.0 - TAILS)
    tailed = normal - np.logaddexp(0.0, math.log(odds) + normal * (1.0 - WIDER**-2)) + math.log1p(odds)
    return np.asarray(np.sum(tailed, axis=1))


def _log_density(fitted: Fit, part: Fold, support: float | None) -> Array:
    """Log density of the judged samples, by blocks of time."""
    task = _whole(fitted, part, support)
    _, logarithm = np.linalg.slogdet(fitted.covariance)
    return _by_blocks(part, task, [-loss(z) - 0.5 * logarithm for z in _innovations(fitted, task)])


def _expected_rise(fitted: Fit, amplitudes: Collection[str], part: Fold, support: float | None) -> Array:
    """Expected rise of the log-likelihood of the judged samples by `amplitudes` if these are right, by blocks."""
    task = _whole(fitted, part, support)
    zero = [name in amplitudes for name in (parameter.name for parameter in task.parameters)]
    without = np.where(zero, 0.0, fitted.minimum.common[: len(zero)])
    less = replace(fitted, minimum=replace(fitted.minimum, common=without))
    both = zip(_innovations(fitted, task), _innovations(less, task), strict=True)
    return _by_blocks(part, task, [loss(one - other) for one, other in both])


def _whole(fitted: Fit, part: Fold, support: float | None) -> Problem:
    return problem(fitted.problem.model, [part.whole], support=support).like(fitted.problem)


def _by_blocks(part: Fold, task: Problem, rows: Sequence[Array]) -> Array:
    """Sums over the judged ones of `rows`, by segment, of blocks of time."""
    found, scale = [], time_scale(task.model, task.segments)
    for segment, each in zip(task.segments, rows, strict=True):
        begin = float(segment.time[0]) + SETTLING * scale
        judged = part.judges(segment.time) & (segment.time >= begin)
        _, number = np.unique(((segment.time[judged] - begin) / (BLOCK * scale)).astype(np.int64), return_inverse=True)
        found.append(np.bincount(number, weights=each[judged]))
    return np.concatenate(found)


def _innovations(fitted: Fit, task: Problem) -> list[Array]:
    """Whitened, by segment (rows, outputs), with the initial state of each fitted."""
    weights = whitening(fitted)
    common = fitted.minimum.common[: len(fitted.problem.free)]
    own = [part.copy() for part in task.own_start]
    blocks: list[Block] = []
    for _ in range(2):
        found = task.evaluate(common, own, weights=weights, gain=fitted.gain, by_common=False)
        if found is None:
            raise ArithmeticError("the model diverges on data that it was not fitted to")
        blocks = found
        own = [
            part - np.linalg.lstsq(block.own, block.residual, rcond=None)[0]
            for part, block in zip(own, blocks, strict=True)
        ]
    outputs = len(task.kernel.outputs)
    return [
        eliminate(block)[0][: len(segment) * outputs].reshape(-1, outputs)
        for segment, block in zip(task.segments, blocks, strict=True)
    ]
