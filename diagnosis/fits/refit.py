"""Fits of the model with one more effect, first a quick fit of every candidate, then full fits of the most promising
ones.

The quick fit holds the filter gain and the innovations' covariance of the model alone and moves parameters, amplitudes
and shapes together, from the score test's amplitudes at its best shapes. The full fit estimates the noise again, too:
with the effect in the model less noise is needed, which is what distinguishes neighbours.
"""

from __future__ import annotations

import math
from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import islice

import numpy as np
from numpy.typing import NDArray

from upright.diagnosis.prepare.candidates import Candidate
from upright.diagnosis.prepare.workspace import Workspace
from upright.diagnosis.score.score_test import Score
from upright.diagnosis.score.whitened import whitening
from upright.estimators.budget import UNLIMITED
from upright.estimators.fit.gauss_newton import Block, Minimum, eliminate, minimise
from upright.estimators.fit.maximum_likelihood import CREEPING as CREEPING
from upright.estimators.fit.maximum_likelihood import ENOUGH, Begin, Fit, fit
from upright.estimators.fit.result import inverse
from upright.models.model import Model
from upright.models.parts import Parameter, Place
from upright.models.random.sensor_error import random_count
from upright.models.sensing import delayed

Array = NDArray[np.float64]

STARTS = 2
"""Shapes from which a quick fit starts: the best of the score test."""
ELSEWHERE = 1.3
"""And the best of those whose first parameter differs by this factor: the score test is linear, and its two best shapes
may lie at the wrong end of a valley. A mode of 5 Hz was started at 10.7 and at 10 Hz, and ended at 11.7 with less than
half of its log-likelihood ratio."""
ITERATIONS = 8
LONGER = 24
"""Iterations of a further fit from amplitude zero, if the first ended above the cost of the model alone: the linear
model holds near zero, and there the first step moves all parameters as in the score test."""
FURTHER_FITS = 2
"""Times that a fit which does not converge is continued."""
COMPARED = 0.02
"""Fall of the cost below which a fit that is only compared with others makes no further step: no parameter would move
by more than a fifth of its standard deviation, and log-likelihood ratios are compared with several."""
LEAST = 0.05
"""Fall of the cost below which a quick fit makes no further step."""
ROUGH = 0.01
"""Share of what the best effect explains to which a quick fit is accurate: a fiftieth of what it decides, whether an
effect explains half as much (diagnosis.search.contenders)."""


@dataclass(frozen=True, slots=True)
class QuickFit:
    """`values` of the effect's parameters; `gain`: rise of the log-likelihood at the noise of the model alone; `end`:
    the values of all parameters with it, and that noise."""

    candidate: Candidate
    values: Mapping[str, float]
    gain: float
    end: Begin


@dataclass(frozen=True, slots=True)
class FullFit:
    """`log_likelihood` at its own noise; `count` of the estimated parameters of its effects and random parts; `rows`:
    number of samples that were fitted."""

    candidate: Candidate | None
    model: Model
    fit: Fit
    log_likelihood: float
    count: int
    rows: int

    @property
    def name(self) -> str:
        """Name of the effect that was added last; empty for the model alone."""
        return self.candidate.name if self.candidate else ""

    @property
    def cost(self) -> float:
        """Price of its effects' parameters (Schwarz): the log-likelihood has to rise by more."""
        return 0.5 * self.count * math.log(self.rows)

    @property
    def evidence(self) -> float:
        """Logarithm of the model's posterior odds, up to a constant."""
        return self.log_likelihood - self.cost

    @property
    def fitted(self) -> Model:
        """The model at the fitted values."""
        return self.model.change(dict(zip(self.fit.problem.kernel.parameters, self.fit.values.tolist(), strict=True)))


def with_effect(model: Model, candidate: Candidate, values: Mapping[str, float]) -> Model:
    """`model` with the candidate at `values`, amplitudes and shapes estimated."""
    wider = model.add(candidate.effect, candidate.attached.at)
    names = [p.name for p in wider.parameters if p.estimated] + list(candidate.shapes)
    return wider.change(dict(values), estimated=names)


def quick(base: Fit, model: Model, score: Score, workspace: Workspace, most: float) -> QuickFit:
    """The best of several starts. `most`: what the best effect explains, nats."""
    starts = [*score.starts[:STARTS], *_elsewhere(score)]
    enough = max(LEAST, ROUGH * most)
    found = [_quick(base, model, score.candidate, start, workspace, enough) for start in starts]
    return max(found, key=lambda each: each.gain)


def _elsewhere(score: Score) -> list[Mapping[str, float]]:
    """The best of the starts beyond the first STARTS that is far from these; empty if there is none."""
    if not score.candidate.shapes:
        return []
    first = score.candidate.shapes[0]
    near = [abs(each[first]) for each in score.starts[:STARTS]]
    far = (each for each in score.starts[STARTS:] if all(_apart(abs(each[first]), other) for other in near))
    return list(islice(far, 1))


def _apart(one: float, other: float) -> bool:
    return max(one, other) > ELSEWHERE * min(one, other)


def _quick(
    base: Fit, model: Model, candidate: Candidate, start: Mapping[str, float], workspace: Workspace, enough: float
) -> QuickFit:
    task = workspace.problem(with_effect(model, candidate, start)).like(base.problem)
    size = len(base.problem.free)
    gain = np.zeros((len(task.kernel.states), len(task.kernel.outputs)))
    gain[: len(base.gain)] = base.gain
    weights = whitening(base)
    further = task.parameters[size:]
    centre = np.concatenate((base.problem.start, task.start[size:]))
    vague = [0.0 if p.name in candidate.amplitudes else 0.1 / shape_spread(p.value, p.typical) for p in further]
    weight = np.concatenate((np.sqrt(base.prior[:size]), vague))

    def evaluate(common: Array, own: Sequence[Array]) -> list[Block] | None:
        blocks = task.evaluate(common, own[:-1], weights=weights, gain=gain)
        if blocks is None:
            return None
        return [*blocks, Block((common - centre) * weight, np.diag(weight), np.zeros((len(weight), 0)))]

    lower, upper = task.bounds
    begin = np.concatenate((base.minimum.common[:size], task.start[size:]))
    starts = zip(base.minimum.own[:-1], task.own_start, strict=True)
    own = [*(np.concatenate((part, whole[len(part) :])) for part, whole in starts), np.zeros(0)]
    alone = begin.copy()
    sizes = [size + place for place, p in enumerate(further) if p.name in candidate.amplitudes]
    alone[sizes] = 0.0
    before = evaluate(np.clip(alone, lower, upper), own)
    # An offset that a delay of the command replaces starts at its prior value: the two must not add up.
    commands = delayed(task.model, task.model.effects[-1]) if candidate.effect.place is Place.ACTUATOR else ()
    same = {name for each in model.inputs if each.name in commands for name in each.delays}
    taken = [place for place, p in enumerate(base.problem.parameters) if p.name in same]
    begin[taken] = base.problem.start[taken]
    if before is None:
        return QuickFit(candidate, dict(start), -np.inf, base.end)
    cost = 0.5 * sum(float(block.residual @ block.residual) for block in before)

    def fitted(common: Array, own: Sequence[Array], iterations: int) -> Minimum | None:
        return minimise(
            evaluate,
            common,
            own,
            scale=task.scale,
            lower=lower,
            upper=upper,
            iterations=iterations,
            tolerance=1e-3,
            enough=enough,
        )

    minimum = fitted(begin, own, ITERATIONS)
    if minimum is not None and minimum.cost >= cost:
        nothing = np.where(np.isin(np.arange(len(begin)), sizes), 0.0, begin)
        minimum = fitted(nothing, own, LONGER) or minimum
    if minimum is None:
        return QuickFit(candidate, dict(start), -np.inf, base.end)
    everything = dict(zip([p.name for p in task.parameters], minimum.common.tolist(), strict=True))
    values = {p.name: everything[p.name] for p in further}
    return QuickFit(candidate, values, cost - minimum.cost, replace(base.end, values=everything))


def shape_spread(value: float, typical: float) -> float:
    """How far a shape may plausibly be from where it started: within an order of magnitude."""
    return max(abs(value), typical)


def full(
    model: Model,
    workspace: Workspace,
    candidate: Candidate | None = None,
    begin: Begin | None = None,
    longer: int = 0,
    enough: float = COMPARED,
    near: Fit | None = None,
) -> FullFit:
    """The fit of `model` with its noise until the cost is not expected to fall by more than `enough`.

    It starts from the model's values, from `begin` or from its fit `near`. `candidate` is the effect that was added
    last. A fit that does not converge is continued from its end, up to `longer` times, as long as that makes a
    difference.
    """
    fitted = fit(workspace.problem(model), near=near, begin=near.end if near else begin, enough=enough)
    for _ in range(longer):
        if fitted.minimum.converged or _creeps(fitted):
            break
        fitted = fit(workspace.problem(model), near=fitted, begin=fitted.end, enough=enough)
    return _full(model, fitted, workspace, candidate)


def as_evident(
    other: FullFit,
    model: Model,
    workspace: Workspace,
    candidate: Candidate | None = None,
    begin: Begin | None = None,
    longer: int = 0,
    enough: float = COMPARED,
) -> FullFit:
    """The fit of `model`, with arguments as of `full`. Where little more is expected, it goes on only if it may end
    with more evidence than `other`: most do not."""
    found = full(model, workspace, candidate, begin, enough=CREEPING)
    if found.evidence + CREEPING <= other.evidence:
        return found
    return full(model, workspace, candidate, longer=longer, enough=enough, near=found.fit)


def exactly(fitted: FullFit, workspace: Workspace) -> FullFit:
    """`fitted` continued until its estimates are exact, for a fit that is reported; unchanged if that fails, or no time
    is left for it."""

    def again() -> Fit:
        return fit(workspace.problem(fitted.model), near=fitted.fit, begin=fitted.fit.end)

    ended = workspace.in_time(again)
    if ended is None or not ended.minimum.converged:
        return fitted
    return _full(fitted.model, ended, workspace, fitted.candidate)


def remembered(
    model: Model, workspace: Workspace, candidate: Candidate | None = None, begin: Begin | None = None
) -> FullFit:
    """The likeliest fit of the hypothesis `model` that was made so far, wherever it started; a new one if there is
    none, with arguments as of `full`."""
    found: FullFit | None = workspace.memory.get(_hypothesis(model))
    return full(model, workspace, candidate, begin) if found is None else replace(found, candidate=candidate)


def _hypothesis(model: Model) -> Hashable:
    """What two variants of one model have in common if fits estimate the same: their own parts, their effects, and
    which parameters of these are held at which value."""
    effects = ((each.name, each.effect, tuple(map(_held_at, each.parameters))) for each in model.effects)
    return model.base_states, model.inputs, model.outputs, model.base_parameters, frozenset(effects)


def _held_at(parameter: Parameter) -> float | None:
    return None if parameter.estimated else parameter.value


def settled(model: Model, workspace: Workspace) -> FullFit:
    """The fit of `model` alone, with which all others are compared: it is restarted from its end until that changes
    nothing. In a narrow valley steps become short, and with fresh ones it has improved by another 1,200 nats."""
    found = full(model, workspace, longer=FURTHER_FITS, enough=ENOUGH)
    for _ in range(FURTHER_FITS):
        fitted = fit(workspace.problem(model), near=found.fit, begin=found.fit.end)
        again = _full(model, fitted, workspace)
        if again.log_likelihood - found.log_likelihood < CREEPING:
            break
        found = again
    return found


def _full(model: Model, fitted: Fit, workspace: Workspace, candidate: Candidate | None = None) -> FullFit:
    # Later evaluations are not limited by the time of the fit.
    fitted = replace(fitted, problem=replace(fitted.problem, budget=UNLIMITED))
    own = {p.name for each in model.effects for p in each.parameters}
    count = sum(p.estimated for p in model.parameters if p.name in own) + random_count(model)
    rows = sum(int(np.isfinite(segment.measured).all(axis=1).sum()) for segment in workspace.segments)
    found = FullFit(candidate, model, fitted, log_likelihood(fitted) - off_prior(fitted), count, rows)
    if fitted.minimum.converged:
        before: FullFit | None = workspace.memory.get(hypothesis := _hypothesis(model))
        if before is None or before.log_likelihood < found.log_likelihood:
            workspace.memory[hypothesis] = found
    return found


def _creeps(fitted: Fit) -> bool:
    """Whether the second half of its steps decided nothing: along a valley there are hundreds more."""
    middle, last = fitted.steps[len(fitted.steps) // 2], fitted.steps[-1]
    return middle.cost - last.cost < CREEPING


def log_ratio(fitted: FullFit, base: FullFit) -> tuple[float, int]:
    """By how much the log-likelihood of `fitted` is above that of `base` (nats), whose model lacks some of its effects,
    and by how many parameters."""
    return fitted.log_likelihood - base.log_likelihood, fitted.count - base.count


def t_ratio(fitted: FullFit, effect: str) -> float:
    """The largest t-ratio of an amplitude of `effect`: its distance from zero in standard deviations, of its own
    estimate or of the estimate that would result if it were zero.

    If it is small, the rise of the log-likelihood comes from the other parameters, which another start would have
    brought there, too. The shape is taken as known: of a creep whose end the record does not show, the final torque is
    undetermined, but its existence is beyond doubt. The same holds if parts collide: derivatives through many impacts
    grow until they no longer determine the width of the backlash, although it raised the log-likelihood by thousands.
    """
    attached = next(each for each in fitted.model.effects if each.name == effect)
    names = [p.name for p in fitted.fit.problem.parameters]
    information = fitted.fit.minimum.information
    shapes = {p.name for p in attached.parameters} - set(attached.amplitudes)
    given = [place for place, name in enumerate(names) if name in shapes]
    known = np.delete(np.arange(len(information)), given)
    deviations = np.sqrt(np.diag(inverse(information[np.ix_(known, known)])))
    std = dict(zip(known.tolist(), deviations.tolist(), strict=True))
    places = [names.index(name) for name in attached.amplitudes if name in names]
    if not places:
        return 0.0
    own = np.array([std[place] for place in places])
    scatter = np.minimum(own, std_at_zero(fitted.fit, places, given))
    return float(np.max(np.abs(fitted.fit.minimum.common[places]) / np.maximum(scatter, 1e-300)))


def inside_bounds(fitted: FullFit) -> bool:
    """Whether the amplitudes of the effect that was added last are inside their bounds, or zero: an amplitude that the
    record drives to the limit of what is physical imitates another cause."""
    assert fitted.candidate is not None
    minimum = fitted.fit.minimum
    return not any(
        p.name in fitted.candidate.amplitudes and at_bound and value != 0.0
        for p, value, at_bound in zip(fitted.fit.problem.parameters, minimum.common, minimum.at_bound, strict=False)
    )


def std_at_zero(fitted: Fit, places: Sequence[int], given: Sequence[int] = ()) -> Array:
    """Standard deviations that the amplitudes at `places` among the parameters would have if they were zero, with those
    at `given` known; infinite if they would show nothing."""
    task, size = fitted.problem, len(fitted.problem.free)
    common = fitted.minimum.common[:size].copy()
    common[list(places)] = 0.0
    with np.errstate(all="ignore"):
        blocks = task.evaluate(
            common, fitted.minimum.own[: len(task.segments)], weights=whitening(fitted), gain=fitted.gain
        )
    if blocks is None:
        return np.full(len(places), np.inf)
    information = np.diag(fitted.prior[:size])
    for block in blocks:
        columns = eliminate(block)[1]
        information = information + columns.T @ columns
    known = np.delete(np.arange(size), list(given))
    deviations = np.full(size, np.inf)
    deviations[known] = np.sqrt(np.diag(inverse(information[np.ix_(known, known)])))
    return np.asarray(deviations[list(places)])


def off_prior(fitted: Fit) -> float:
    """Cost of the deviation of the parameters from their priors."""
    size = len(fitted.problem.free)
    off = fitted.minimum.common[:size] - fitted.problem.start
    return 0.5 * float(np.sum(fitted.prior[:size] * off**2))


def log_likelihood(fitted: Fit) -> float:
    """Log-likelihood of the innovations under their own covariance, without the constant that all models share."""
    _, logarithm = np.linalg.slogdet(fitted.covariance)
    total = 0.0
    for innovations in fitted.innovations():
        known = innovations[np.isfinite(innovations).all(axis=1)]
        total -= (
            0.5 * float(np.sum(known * np.linalg.solve(fitted.covariance, known.T).T)) + 0.5 * len(known) * logarithm
        )
    return float(total)
