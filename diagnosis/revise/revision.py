"""A model with an effect added: does the error fall, on data it was not fitted to either, and does that prove anything?

The model is fitted without and with the effect by prediction error, from the same CAD values, and both are compared on
the same records: those that they were fitted to, and those that were held out. The error budget is that of the error
half a second ahead, not of the innovations: from one sample to the next nearly all of the error is sensor noise, while
what is missing in the equations adds up over time, and that is what matters to a controller or a simulation. Channels
are weighted by their energy over that of a correct model with the sensors alone
(diagnosis.prediction.ahead.sensor_floors), on held-out data.

A falling error alone proves little: a neighbour, an effect that does almost the same to this record, makes it fall
nearly as far. So the effect's neighbours are fitted, too, and reported with their odds.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from upright.diagnosis.lack_of_fit.floor import floor, innovation_ratio, shaken_as
from upright.diagnosis.prediction.ahead import errors, on, sensor_floors
from upright.diagnosis.prepare.actuator_samples import as_recorded_rows, at_samples, looked_at, of_actuators
from upright.diagnosis.prepare.candidates import Candidate, candidate_of
from upright.diagnosis.prepare.ready import ready, unready
from upright.diagnosis.revise import with_and_without as fits
from upright.diagnosis.revise.drop_tests import DropTest as DropTest
from upright.diagnosis.revise.drop_tests import drop_tests as drop_tests
from upright.diagnosis.revise.result import Budget, Errors, FittedParameter, Moved, Neighbour, Revision, Side
from upright.diagnosis.revise.split import split
from upright.diagnosis.revise.with_and_without import Estimated
from upright.estimators.contract import EstimationError
from upright.estimators.data.resting import without_rests
from upright.estimators.data.segments import after_settling, channels_of, optional_channels
from upright.estimators.data.time_scale import time_scale
from upright.estimators.fit.maximum_likelihood import Fit
from upright.estimators.fit.problem import problem
from upright.estimators.fit.released import released
from upright.models.effect import Effect
from upright.models.effects.catalogue import find
from upright.models.model import Model
from upright.models.natural_time import rounded
from upright.models.parts import ModelError
from upright.models.text.expressions import names_in
from upright.telemetry.recording import Recording

Array = NDArray[np.float64]
Progress = Callable[[str, float], None]
"""Called with a text that says what is being done, and the share that is done, 0 to 1."""

HORIZONS = (0.125, 0.5, 1.25)
"""Time scales (estimators.data.time_scale) ahead at which errors are given, 0.05, 0.2 and 0.5 s of the MONOCAB; the
last is that of the budget."""
BLOCKS = 10
"""Parts of the held-out data whose scatter gives the standard error of a difference between two models."""


@dataclass(frozen=True, slots=True)
class _Held:
    """Held-out data, and a correct model's RMS errors there at each of `horizons` (s), `floor` (nh, ny)."""

    recordings: Sequence[Recording]
    support: float | None
    horizons: tuple[float, ...]
    floor: Array

    def errors(self, fitted: Estimated) -> list[Array]:
        """(m, ny) by horizon."""
        return errors(_on(fitted, self.recordings, self.support), self.horizons)

    def energy(self, found: Sequence[Array]) -> Array:
        """Energy over a correct model's, at the last horizon, the mean of the channels: (m,)."""
        return np.asarray(np.nanmean((found[-1] / self.floor[-1]) ** 2, axis=1))


def revise(
    model: Model,
    effect: Effect | str,
    recordings: Sequence[Recording],
    held_out: Sequence[Recording] = (),
    *,
    at: str = "",
    support: float | None = None,
    progress: Progress | None = None,
) -> Revision:
    """Fit `model` without and with `effect` (at `at`, by default the first place), and compare the errors.

    Its parameter values and standard deviations are the prior of all fits. Without `held_out`, the last third of each
    recording in time is held out, and everything is fitted to the first two. `support` rad: the vehicle is free where
    its roll is less. A model of actuators alone is compared with the samples from which they are diagnosed.

    Raises:
        ModelError: no such effect, or the model cannot have it.
        DataError: the recordings cannot be used; names channel and reason.
        EstimationError: the fit fails, so there is no result.
    """
    report = progress or (lambda text, share: None)
    if of_actuators(model):
        rows = at_samples(model)
        fitted, tried = (looked_at(rows, each, support) for each in (recordings, held_out))
        found = _revise(rows, effect, fitted, tried, at, support, report)
        return replace(found, model=as_recorded_rows(model, found.model))
    found = _revise(ready(model, recordings), effect, recordings, held_out, at, support, report)
    return replace(found, model=unready(model, found.model))


def _revise(
    model: Model,
    effect: Effect | str,
    recordings: Sequence[Recording],
    held_out: Sequence[Recording],
    at: str,
    support: float | None,
    report: Progress,
) -> Revision:
    recordings, held_out = (
        without_rests(model, after_settling(model, each, support)) for each in (recordings, held_out)
    )
    candidate = candidate_of(model, model.add(effect, at).effects[-1])
    neighbours = _neighbours(model, candidate, recordings)
    training, tried = split(model, recordings, held_out, support)
    samples = fits.training(model, training, support, (candidate, *neighbours))
    report(f"fitting without {candidate.name}", 0.0)
    without = Estimated.of(fits.alone(model, samples))
    if (with_more := released(model, without.full.fit)) is not model:
        model, without = with_more, Estimated.of(fits.alone(with_more, samples))
    report(f"fitting with {candidate.name} and its neighbours", 0.2)
    found, scored = fits.each_with(
        without.full, (candidate, *neighbours), samples, lambda text, share: report(text, 0.2 + 0.6 * share)
    )
    if candidate.name not in found:
        why = samples.failed.get(candidate.name, "no fit with it succeeds")
        raise EstimationError(f"effect {candidate.name}", why, remedy="check the model with `upright compare`.")
    report("comparing them on held-out data", 0.8)
    fitted = Estimated.of(found[candidate.name])
    there = _on(fitted, tried, support)
    horizons = horizons_of(there)
    held = _Held(tried, support, horizons, sensor_floors(there, horizons))
    outputs = fitted.full.fit.problem.kernel.outputs
    found_before, found_after = held.errors(without), held.errors(fitted)
    energy_before, energy_after = held.energy(found_before), held.energy(found_after)
    rivals = []
    for each in neighbours:
        if each.name not in found:
            continue  # it cannot explain these records at all
        rival = Estimated.of(found[each.name])
        energy = held.energy(held.errors(rival))
        both = {candidate.name, each.name} <= scored.bases.keys()
        rivals.append(
            Neighbour(
                effect=each.name,
                bic_difference=rival.bic - fitted.bic,
                fall=Budget.of(float(np.mean(energy_before)), float(np.mean(energy))).fall,
                t_ratio=_t_ratio(energy_after - energy),
                correlation=scored.similarity(candidate.name, each.name) if both else None,
                separated_by=each.effect.separated_by,
            )
        )
    report("done", 1.0)
    return Revision(
        model=fitted.model,
        effect=candidate.name,
        title=candidate.effect.title,
        at=candidate.attached.at,
        recordings=tuple(each.source for each in recordings),
        held_out=tuple(each.source for each in held_out)
        or tuple(f"last third of {each.source}" for each in recordings),
        horizons=horizons,
        before=_side(without, fitted, _rms(found_before), horizons),
        after=_side(fitted, fitted, _rms(found_after), horizons),
        floor_training=_by_channel(sensor_floors(fitted.full.fit, horizons), outputs),
        floor_held_out=_by_channel(held.floor, outputs),
        budget=Budget.of(float(np.mean(energy_before)), float(np.mean(energy_after))),
        moved=_moved(without, fitted),
        neighbours=tuple(sorted(rivals, key=lambda each: each.bic_difference)),
        separated_by=candidate.effect.separated_by,
        uses_time=any("time" in names_in(text) for text in candidate.effect.expressions.values()),
        t_ratio=fitted.t_ratio(candidate.name),
    )


def _neighbours(model: Model, candidate: Candidate, recordings: Sequence[Recording]) -> list[Candidate]:
    """Effects that are confusable with `candidate`, if the model can have them and does not have them yet, and if their
    channels are recorded."""
    found = []
    there = {attached.effect.name for attached in model.effects}
    for name in candidate.effect.confused_with:
        if name in there:
            continue
        try:
            effect = find(name)
            at = candidate.attached.at if effect.place is candidate.effect.place else ""
            with_it = model.add(effect, at)
        except ModelError:
            continue
        needed = set(channels_of(with_it)) - optional_channels(with_it)
        if all(channel in each.values for each in recordings for channel in needed):
            found.append(candidate_of(model, with_it.effects[-1]))
    return found


def _over_floor(fitted: Estimated, best: Estimated) -> float:
    """Innovation energy over that of a correct model, whose gain is linearised in motion: at rest friction is too
    stiff."""
    task, values = shaken_as(fitted.full.fit.problem, fitted.full.fit.values, best.full.fit)
    moving = values.copy()
    moving[[task.kernel.index(name) for each in task.model.effects for name in each.amplitudes]] = 0.0
    return innovation_ratio(task, values, floor(task, moving))


def _on(fitted: Estimated, recordings: Sequence[Recording], support: float | None) -> Fit:
    return on(fitted.full.fit, problem(fitted.full.model, recordings, support=support))


def horizons_of(fitted: Fit) -> tuple[float, ...]:
    """s ahead at which errors of a fit are given."""
    scale = time_scale(fitted.problem.model, fitted.problem.segments)
    return tuple(rounded(each * scale) for each in HORIZONS)


def _rms(found: Sequence[Array]) -> Array:
    return np.array([np.sqrt(np.nanmean(each**2, axis=0)) for each in found])


def _t_ratio(difference: Array) -> float:
    """The mean of `difference` (m,) over its standard error, from blocks, since neighbouring samples are correlated."""
    means = np.array([np.mean(block) for block in np.array_split(difference, BLOCKS)])
    return float(np.mean(means) / max(np.std(means, ddof=1) / np.sqrt(BLOCKS), 1e-300))


def _by_channel(rms: Array, outputs: Sequence[str]) -> Errors:
    return {name: tuple(column.tolist()) for name, column in zip(outputs, rms.T, strict=True)}


def _side(fitted: Estimated, best: Estimated, held_out: Array, horizons: Sequence[float]) -> Side:
    """One model, with the disturbance that the `best` leaves."""
    outputs = fitted.full.fit.problem.kernel.outputs
    parameters = {
        name: FittedParameter(fitted.values[name], fitted.deviations[name], each.unit, each.status.value, each.reason)
        for name, each in fitted.estimate.parameters.items()
    }
    return Side(
        log_likelihood=fitted.log_likelihood,
        bic=fitted.bic,
        parameters=parameters,
        training=_by_channel(_rms(errors(fitted.full.fit, horizons)), outputs),
        held_out=_by_channel(held_out, outputs),
        innovation_ratio=_over_floor(fitted, best),
        disturbance=fitted.estimate.disturbance,
    )


def _moved(without: Estimated, fitted: Estimated) -> dict[str, Moved]:
    return {
        p.name: Moved(
            p.value, p.std, (without.values[p.name] - p.value) / p.std, (fitted.values[p.name] - p.value) / p.std
        )
        for p in without.full.fit.problem.parameters
        if p.std > 0.0
    }
