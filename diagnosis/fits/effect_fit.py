"""A model fitted with an effect as well as it can be: from several shapes, and with its shape where a record tells it.

An effect with a shape (a frequency, a rate, a gap) has many minima, so the fit begins at several: the one that the
score test likes best (diagnosis.score.score_test), and those the effect itself names. The shape is then estimated too,
as far as the record tells it; a shape that it does not tell stays where it is. The best likelihood stays.

Where parts strike each other it is not smooth: a blow that comes a row early or late costs as much as one that nobody
expected, so fits end hundreds apart of thousands that they gain, and some of them with a filter that each blow throws
off. There each shape is begun with all else at what was known before and at where the model without the effect ended,
and of those that gain almost as much as the best the one stays that foretells its own record best, half a second ahead.

As in a diagnosis (diagnosis.fits.finer), an effect that has a finer formula is fitted by that as well.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray

from diagnosis.fits.refit import off_prior, scatter_of_none
from diagnosis.prediction.ahead import errors
from diagnosis.prepare.candidates import Candidate
from diagnosis.score.score_test import Score
from diagnosis.side_by_side import side_by_side
from estimators.contract import Estimate, EstimationError, Status
from estimators.data.time_scale import time_scale
from estimators.fit.innovations import NoiseModel
from estimators.fit.maximum_likelihood import MUCH, Begin, Fit, fit, noise_of
from estimators.fit.problem import problem
from estimators.fit.result import inverse
from estimators.methods.prediction_error import result
from estimators.stopwatch import stopwatch
from models.attach import starts
from models.compiler.kernel import Progress
from models.effect import AttachedEffect
from models.model import Model
from models.natural_time import rounded
from models.random.disturbance import undriven
from telemetry.recording import Recording

Array = NDArray[np.float64]

HORIZONS = (0.125, 0.5, 1.25)
"""Time scales (estimators.data.time_scale) ahead at which errors are told, 0.05, 0.2 and 0.5 s of the MONOCAB; the last
is that of the budget."""
UNKNOWN = 1e6
"""Typical sizes: the standard deviation of a parameter that the record says nothing of, as a number."""
MOST_STARTS = 8
"""Shapes of one effect that fits begin with."""
ALMOST = 0.9
"""Share of the best fit's gain with which another one is asked what it foretells."""


@dataclass(frozen=True, slots=True)
class Fitted:
    """A fit and what it is worth. `log_likelihood` of Gaussian innovations, less what parameters off their priors cost;
    `bic` = parameters ln(rows) - 2 of it.

    `values` and `deviations` by name of every estimated parameter, also of those that `estimate` does not tell.
    """

    fit: Fit
    log_likelihood: float
    bic: float
    estimate: Estimate
    values: Mapping[str, float]
    deviations: Mapping[str, float]

    @property
    def prior(self) -> Model:
        """The model that was fitted, with the values it began with."""
        return self.fit.problem.model

    def surety(self, effect: str) -> float:
        """By how many standard deviations the largest amplitude of its `effect` is away from zero, at least.

        Of its own, or of what it would scatter by were there none of it: how well a scale is known that all forces have
        in common, as a mass, says how large an effect is, and nothing of whether there is one.
        """
        attached = next(each for each in self.prior.effects if each.name == effect)
        names = [parameter.name for parameter in self.fit.problem.parameters]
        places = [names.index(name) for name in attached.amplitudes if name in names]
        if not places:
            return float("inf")
        sizes = np.abs(self.fit.minimum.common[places])
        own = np.array([self.deviations[names[place]] for place in places])
        return float(np.max(sizes / np.maximum(np.minimum(own, scatter_of_none(self.fit, places)), 1e-300)))

    @property
    def model(self) -> Model:
        """With the fitted values and their standard deviations."""
        return self.prior.change(self.values, deviations=self.deviations)


def fit_model(
    model: Model,
    recordings: Sequence[Recording],
    *,
    support: float | None = None,
    progress: Progress | None = None,
) -> Fitted:
    """`model` fitted to `recordings` by prediction error, its CAD values as prior.

    Effects that nothing is known of from before are started from zero as well as from the model's values, since a large
    friction may be no start at all: at rest, where the first filter gain is made, it is all there is.

    Raises DataError where the data cannot be used, EstimationError where the model runs away. A fit that did not settle
    says so in `estimate`.
    """
    neutral = model.change({
        name: 0.0 for each in model.effects for name in each.amplitudes
        if model.parameter(name).estimated and not model.parameter(name).std
    })  # fmt: skip
    found: list[Fitted] = []
    for start in (model, neutral) if neutral != model else (model,):
        try:
            found.append(_fitted(start, recordings, support, progress))
        except (ArithmeticError, np.linalg.LinAlgError) as error:
            failed = error
    if found:
        return max(found, key=lambda each: each.log_likelihood)
    remedy = "check the model against the recording with `upright compare`."
    raise EstimationError(f"model {model.name}", str(failed), remedy=remedy) from failed


def _fitted(
    model: Model,
    recordings: Sequence[Recording],
    support: float | None,
    progress: Progress | None = None,
    begin: Begin | None = None,
) -> Fitted:
    """One fit: from the model's values, or from `begin` where that has them. Raises what those that it calls raise."""
    began = stopwatch()
    task = problem(model, recordings, support=support, progress=progress)
    with np.errstate(all="ignore"):  # a start that runs away is one that is not taken
        fitted = fit(task, begin=begin)
        estimate = result(fitted, began)
        covariance = inverse(fitted.minimum.information)
    names = [parameter.name for parameter in task.parameters]
    count = len(names)
    deviations = np.minimum(np.sqrt(np.diag(covariance)[:count]), UNKNOWN * task.scale)
    told = {name: p.std for name, p in estimate.parameters.items() if p.std is not None}
    likelihood = _log_likelihood(fitted) - off_prior(fitted)
    return Fitted(
        fit=fitted,
        log_likelihood=likelihood,
        bic=(count + NoiseModel.of(fitted.problem).size) * float(np.log(task.rows)) - 2.0 * likelihood,
        estimate=estimate,
        values=dict(zip(names, fitted.minimum.common[:count].tolist(), strict=True)),
        deviations=dict(zip(names, deviations.tolist(), strict=True)) | told,
    )


def fit_effect(
    model: Model,
    candidate: Candidate,
    recordings: Sequence[Recording],
    without: Fitted,
    *,
    score: Score | None = None,
    support: float | None = None,
    most: int = MOST_STARTS,
) -> Fitted:
    """`model` with the effect of `candidate`, from at most `most` shapes; `without` is the fit of `model` to the same
    `recordings`, and `score` what the score test says of the effect. Its finer formula stays where that is likelier.

    Raises DataError and EstimationError as `fit_model`, the latter only where every start fails.
    """
    starts = _starts(model, candidate, score)[:most]
    usual = _fit_formula(model, candidate, starts, recordings, without, support)
    if candidate.effect.finer is None:
        return usual
    finer = candidate_of(model, model.add(candidate.effect.finer, candidate.attached.at).effects[-1])
    known = usual.model.values
    begun = {**finer.variants[0], **{p.name: known[p.name] for p in candidate.attached.parameters}}
    try:
        by_finer = _fit_formula(model, finer, [begun], recordings, without, support)
    except EstimationError:
        return usual
    return _best([usual, by_finer], without, candidate.effect.strikes)


def _fit_formula(
    model: Model,
    candidate: Candidate,
    shapes: Sequence[Mapping[str, float]],
    recordings: Sequence[Recording],
    without: Fitted,
    support: float | None,
) -> Fitted:
    """The same by the formula of `candidate` alone, from each of `shapes`, which may have amplitudes."""
    with_it = model.add(candidate.effect, candidate.attached.at)
    problem(with_it, recordings, support=support)  # compiled before two threads ask for it
    strikes = candidate.effect.strikes
    ends = (None, without.fit.end) if strikes else (None,)
    starts = [with_it.change(shape) for shape in shapes]
    still = [(start, _undisturbed(start, recordings, support)) for start in starts]
    found = _fits(starts, recordings, support, ends, [(start, end) for start, end in still if end is not None])
    best = _best(found, without, strikes)
    free = [name for name in candidate.shapes if best.prior.parameter(name).scale > 0.0]
    base = [parameter.name for parameter in best.fit.problem.parameters]
    start = best.prior.change({name: value for name, value in best.values.items() if name in candidate.amplitudes})
    for _ in range(2):
        # Without any of the effect its shape means nothing.
        if not free or best.bic >= without.bic:
            break
        ends = (None, best.fit.end) if strikes else (None,)
        try:
            trials = _fits([start.change(estimated=(*base, *free))], recordings, support, ends)
        except EstimationError:
            break
        trial = _best(trials, without, strikes)
        told = [name for name in free if trial.estimate.parameters[name].status in (Status.OK, Status.AT_BOUND)]
        if told == free:
            return _best([best, trial], without, strikes)
        start = start.change({name: trial.values[name] for name in told})
        free = told
    return best


def _undisturbed(start: Model, recordings: Sequence[Recording], support: float | None) -> Begin | None:
    """Where a fit of `start` without its disturbances ends, with little of them: beside what is missing a disturbance
    has grown to it, and leaves the effect nothing. None where there is none, or that fit runs away."""
    still = undriven(start)
    if still == start:
        return None
    try:
        ended = _fitted(still, recordings, support).fit.end.values
    except (EstimationError, ArithmeticError, np.linalg.LinAlgError):
        return None
    return Begin(ended, noise_of(problem(start, recordings, support=support), shaken=-MUCH))


def _fits(
    starts: Sequence[Model],
    recordings: Sequence[Recording],
    support: float | None,
    ends: Sequence[Begin | None],
    more: Sequence[tuple[Model, Begin]] = (),
) -> list[Fitted]:
    """Fits from each of `starts`: from its own values, where None is among `ends`, and with all but the parameters that
    a fit did not have at where that ended; and those of `more`. Raises EstimationError where none succeeds."""
    failed: list[Exception] = []

    def fitted(start: Model, end: Begin | None) -> Fitted | None:
        try:
            if end is None:
                return fit_model(start, recordings, support=support)
            return _fitted(start, recordings, support, begin=end)
        except (EstimationError, ArithmeticError, np.linalg.LinAlgError) as error:
            failed.append(error)
            return None

    tries = [*((start, end) for end in ends for start in starts), *more]
    found = [each for each in side_by_side(lambda each: fitted(*each), tries) if each is not None]
    if not found:
        first = failed[0]
        remedy = "check the model against the recording with `upright compare`."
        raise (
            first
            if isinstance(first, EstimationError)
            else EstimationError(f"model {starts[0].name}", str(first), remedy=remedy)
        )
    return found


def _best(found: Sequence[Fitted], without: Fitted, strikes: bool) -> Fitted:
    """The likeliest of `found` (by BIC); where parts strike, the one of those that gain almost as much as that which
    foretells best."""
    gains = [without.bic - each.bic for each in found]
    near = [each for each, gain in zip(found, gains, strict=True) if gain >= ALMOST * max(gains)]
    if not strikes or len(near) < 2 or max(gains) <= 0.0:
        return found[int(np.argmax(gains))]
    return min(near, key=lambda each: _off_ahead(each, without))


def _off_ahead(fitted: Fitted, without: Fitted) -> float:
    """Energy of the error the last horizon ahead on the record that was fitted, over that of the model `without`;
    infinite where the model runs away."""
    with np.errstate(all="ignore"):
        last = horizons_of(fitted.fit)[-1:]
        with_it, before = (np.nanmean(errors(each.fit, last)[0] ** 2, axis=0) for each in (fitted, without))
        off = float(np.mean(with_it / np.maximum(before, 1e-300)))
    return off if np.isfinite(off) else np.inf


def horizons_of(fitted: Fit) -> tuple[float, ...]:
    """s ahead at which errors of a fit are told."""
    scale = time_scale(fitted.problem.model, fitted.problem.segments)
    return tuple(rounded(each * scale) for each in HORIZONS)


def candidate_of(model: Model, attached: AttachedEffect) -> Candidate:
    """`attached`, the last effect of a model that was `model` before, with the shapes it names."""
    names = [p.name for p in attached.effect.parameters if not p.amplitude]
    values = product(*(starts(model, attached, name) for name in names))
    qualified = [attached.qualified(name) for name in names]
    return Candidate(attached, tuple(dict(zip(qualified, each, strict=True)) for each in values))


def _starts(model: Model, candidate: Candidate, score: Score | None) -> list[Mapping[str, float]]:
    """Values of shapes and amplitudes to start from, the most promising first: those of the score test, if there is
    one.

    From none of it the first steps may make up for it by all else: friction of the robot's gears ended with four times
    the motors' resistance, 1,900 below what it gains from any friction on."""
    shapes = list(candidate.variants)
    if score is not None:
        shapes = [score.starts[0], *(each for each in shapes if each != score.shape)]
    further: dict[str, tuple[float, ...]] = {}
    for parameter in candidate.effect.parameters:
        if parameter.amplitude and parameter.starts:
            name = candidate.attached.qualified(parameter.name)
            further[name] = starts(model, candidate.attached, parameter.name)[1:]
    amplitudes = [{name: value} for name, values in further.items() for value in values]
    return [shapes[0], *({**shapes[0], **each} for each in amplitudes), *shapes[1:]]


def _log_likelihood(fitted: Fit) -> float:
    errors = np.concatenate(fitted.innovations())
    known = np.where(np.isfinite(errors), errors, 0.0)
    root = np.linalg.cholesky(fitted.covariance)
    white = np.linalg.solve(root, known.T)
    constant = errors.shape[1] * np.log(2.0 * np.pi) + 2.0 * np.sum(np.log(np.diag(root)))
    return float(-0.5 * (np.sum(white**2) + len(errors) * constant))
