"""Effects that the score test does not see, or mistakes for others: fitted from the model's own values, whatever it
says.

A further lag makes the lag of a speed loop grow, until what is left of it no longer looks like a lag: the derivative
there points elsewhere. The significance of such an effect's log-likelihood ratio is computed from blocks of time,
because innovations of a model without the effect are not white.

Parts with backlash between them collide at other instants with each width of the gap, so the derivative at zero width
says nothing. In the fit of the model alone, parameters and noise have absorbed what the impacts do. Fits of backlash
that started there stayed at a tenth of its width, with 5 % of the log-likelihood ratio that they reach from the prior
values.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from upright.diagnosis.fits.refit import (
    CREEPING,
    FURTHER_FITS,
    FullFit,
    as_evident,
    full,
    log_likelihood,
    off_prior,
    with_effect,
)
from upright.diagnosis.prediction.ahead import errors
from upright.diagnosis.prepare.candidates import Candidate
from upright.diagnosis.prepare.workspace import Workspace, attached
from upright.diagnosis.score.whitened import BLOCK
from upright.diagnosis.side_by_side import side_by_side
from upright.diagnosis.trial import FAILURES
from upright.estimators.budget import OutOfTime
from upright.estimators.data.time_scale import horizon, time_scale
from upright.estimators.fit.maximum_likelihood import Begin, fit
from upright.estimators.tails import normal_sf
from upright.models.attach import starts
from upright.models.model import Model
from upright.models.parts import Place

Array = NDArray[np.float64]

START = 2
"""Index among the starts of an effect: between the smallest and the largest usual value."""
TRIED = 10
"""Steps of the first fit from each shape of an effect whose parts collide."""
FITTED = 2
"""Number of these fits, the likeliest, that are continued."""
ALMOST = 0.9
"""Share of the best fit's log-likelihood ratio above which fits are compared by how well they predict: fits of one
model end that far apart (docs/decisions.md, "Of fits with backlash ...")."""


def fits(base: FullFit, workspace: Workspace, names: Collection[str], known: Collection[str] = ()) -> list[FullFit]:
    """Full fits of the model of `base` with each of the candidates `names` and of those whose parts collide, except the
    `known` ones, whose fits exist."""
    others = [each for each in workspace.others(base.model) if each.name not in known]
    chosen = [each for each in others if each.effect.name in names and not each.effect.impacts]
    # Compiled one after the other, before two threads need them.
    ready = [workspace.in_time(partial(_from_usual, base.model, each, workspace), each.name) for each in chosen]
    fitted = side_by_side(partial(_fitted, base, workspace), [each for each in ready if each is not None])
    found = [each for each in fitted if each is not None]
    for candidate in others:
        if candidate.effect.impacts:
            try:
                found += _with_impacts(base, candidate, workspace)
            except OutOfTime:
                workspace.leave(candidate.name)
    return found


def _from_usual(model: Model, candidate: Candidate, workspace: Workspace) -> tuple[Candidate, Model]:
    """`model` with the candidate at its usual amplitudes, compiled."""
    own = candidate.attached
    values = {own.qualified(each): starts(model, own, each)[START] for each in own.effect.amplitudes}
    wider = _with(model, candidate, values)
    workspace.problem(wider)
    return candidate, wider


def _fitted(base: FullFit, workspace: Workspace, start: tuple[Candidate, Model]) -> FullFit | None:
    """The full fit from `start`; None if it fails, or time runs out."""
    (candidate, wider), hurried = start, workspace.for_one

    def one() -> FullFit:
        return _other_way_round(as_evident(base, wider, hurried, candidate, longer=FURTHER_FITS), hurried)

    return workspace.in_time(one, candidate.name)


def _with_impacts(base: FullFit, candidate: Candidate, workspace: Workspace) -> list[FullFit]:
    """The full fit with the candidate that predicts its record best, among the fits from its shapes that explain almost
    as much as the likeliest; empty if no fit succeeds.

    An impact that comes a sample early or late costs as much as one that was not predicted at all. So fits end hundreds
    of nats apart, of thousands that they explain, and some of them with a filter that each impact throws off. The
    two starts of the noise are compared with the first shape only. The other shapes start with the noise of its fit.
    """
    starts = [with_effect(base.model, candidate, shape) for shape in candidate.variants]
    workspace.problem(starts[0])  # compiled before two threads need it

    def tried(start: Model, begin: Begin | None = None) -> tuple[float, Begin] | None:
        try:
            found = fit(workspace.problem(start), iterations=TRIED, begin=begin, enough=CREEPING)
        except FAILURES:
            return None
        return log_likelihood(found) - off_prior(found), found.end

    def fitted(end: Begin) -> FullFit | None:
        try:
            return as_evident(base, starts[0], workspace, candidate, end, FURTHER_FITS)
        except FAILURES:
            return None

    first = tried(starts[0])
    begin = None if first is None else Begin({}, first[1].noise)
    near = [each for each in (first, *side_by_side(partial(tried, begin=begin), starts[1:])) if each is not None]
    near.sort(key=lambda each: -each[0])
    ends = side_by_side(fitted, [end for _, end in near[:FITTED]])
    found = [each for each in ends if each is not None and each.fit.minimum.converged]
    most = max((each.log_likelihood - base.log_likelihood for each in found), default=0.0)
    almost = [each for each in found if each.log_likelihood - base.log_likelihood >= ALMOST * most]
    return [min(almost, key=lambda each: _off_ahead(each, almost[0]))] if almost else []


def _off_ahead(fitted: FullFit, other: FullFit) -> float:
    """Energy of the error a horizon ahead on the record that was fitted, over that of the `other` fit; infinite if the
    model diverges."""
    with np.errstate(all="ignore"):
        reach = horizon(other.fit.problem.model, other.fit.problem.segments)
        energy, least = (np.nanmean(errors(each.fit, (reach,))[0] ** 2, axis=0) for each in (fitted, other))
        off = float(np.mean(energy / np.maximum(least, 1e-300)))
    return off if np.isfinite(off) else np.inf


def _other_way_round(one: FullFit, workspace: Workspace) -> FullFit:
    """`one`, or the fit with its two lags in series exchanged, if that is nearer to the prior of the first: a record
    hardly determines which of them comes first."""
    candidate = one.candidate
    first = speed_loop_lag(one.model)
    if candidate is None or not candidate.effect.lag or not first:
        return one
    further, values = candidate.attached.qualified(candidate.effect.lag), one.fitted.values
    both = ((first, further), (further, first))
    about = {name: float(np.clip(values[other], *_bounds(one.model, name))) for name, other in both}
    end = one.fit.end
    try:
        other = full(one.model, workspace, candidate, replace(end, values={**end.values, **about}))
    except FAILURES:
        return one
    return max(one, other, key=lambda each: each.log_likelihood)


def speed_loop_lag(model: Model) -> str:
    """The parameter of `model` that is the lag of its actuators; empty if it has none."""
    return next((each.lag for each in model.actuators if each.lag), "")


def _bounds(model: Model, name: str) -> tuple[float, float]:
    return model.parameter(name).lower, model.parameter(name).upper


def together(model: Model, workspace: Workspace, names: Collection[str]) -> list[FullFit]:
    """One full fit with all of the candidates `names` in the model; empty if there are none or the fit fails."""
    chosen = [each for each in workspace.others(model) if each.effect.name in names]
    if not chosen:
        return []
    wider = attached(model, chosen)
    try:
        return [full(wider, workspace, chosen[-1])]
    except FAILURES:
        return []


def _with(model: Model, candidate: Candidate, values: Mapping[str, float]) -> Model:
    """`model` with the effect; an offset of the input that it delays is held, since the two are identical."""
    wider = with_effect(model, candidate, values)
    if not (candidate.effect.delay and candidate.effect.place is Place.ACTUATOR):
        return wider
    command = next(each.command for each in model.actuators if each.name == candidate.attached.at)
    same = next(each.delays for each in model.inputs if each.name == command)
    return wider.change(estimated=[p.name for p in wider.parameters if p.estimated and p.name not in same])


def surprise(base: FullFit, other: FullFit) -> float:
    """p-value of the log-likelihood ratio of `other` to `base`, if it were a random walk of independent blocks."""
    rises, task = [], base.fit.problem
    block = max(1, round(BLOCK * time_scale(task.model, task.segments) / _spacing(base)))
    for one, more in zip(_densities(base), _densities(other), strict=True):
        rows = len(one) // max(1, len(one) // block)
        rises.append(np.add.reduceat(more - one, np.arange(0, len(one), rows)))
    blocks = np.concatenate(rises)
    spread = float(np.sqrt(len(blocks)) * np.std(blocks, ddof=1))
    return float(normal_sf(np.sum(blocks) / spread)) if spread > 0.0 else 1.0


def _spacing(fitted: FullFit) -> float:
    return float(np.median(np.diff(fitted.fit.problem.segments[0].time)))


def _densities(fitted: FullFit) -> list[Array]:
    """By segment, the log density of each sample (n,) up to a constant; 0 where nothing was measured."""
    covariance = fitted.fit.covariance
    _, logarithm = np.linalg.slogdet(covariance)
    found = []
    for innovations in fitted.fit.innovations():
        density = -0.5 * np.sum(innovations * np.linalg.solve(covariance, innovations.T).T, axis=1) - 0.5 * logarithm
        found.append(np.where(np.isfinite(density), density, 0.0))
    return found
