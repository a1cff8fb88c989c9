"""Chooses which of several known speed loops a record's actuators have, and the ramp with which they follow.

A speed loop is not known beforehand. Of several models the one is chosen that explains a part of the record best, alone
or with an effect that imitates its order: a lag and a further lag look like a loop of second order. Nor is the ramp of
the drives known: if it acts for longer than a sample, the one that explains most is chosen.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.optimize import minimize_scalar

from upright.diagnosis.evidence import likelier
from upright.diagnosis.fits import confounded
from upright.diagnosis.fits.confounded import speed_loop_lag
from upright.diagnosis.fits.refit import FullFit, full
from upright.diagnosis.lack_of_fit.floor import sensor_noise
from upright.diagnosis.prepare.actuator_samples import middle
from upright.diagnosis.prepare.workspace import Workspace
from upright.diagnosis.trial import FAILURES
from upright.models.effect import Effect
from upright.models.model import Model
from upright.models.natural_time import USUAL, natural_time
from upright.telemetry.recording import Recording

LOOKED_AT = 20.0
"""Natural times (models.natural_time; 8 s of the MONOCAB) of a record from which the speed loop is chosen."""
FORMULA = 0.06
"""Relative accuracy of the lag in the formula of a speed loop: a further lag that is smaller is part of it.

On eleven clean records of the virtual vehicle (seven of multisine, one each of sweep, square, step and rest) a further
lag came out as 0 to 0.038 of the speed loop's.
"""
LONGER = 0.01
"""Share of the samples in which the drives' ramp takes longer than the sample, above which its shape counts."""
SLOWER = 3.0
"""Factor by which a ramp may be slower than the fastest that takes longer than a sample."""


def speed_loop(
    actuators: Sequence[Model], recordings: Sequence[Recording], effects: Sequence[Effect]
) -> tuple[Model, tuple[str, ...]]:
    """The model that explains LOOKED_AT best, with the ramp that does, and which of the effects with which the lag of a
    speed loop is confounded may be missing there.

    Raises DataError if the recordings cannot be used, ArithmeticError if no model can be fitted to them.
    """
    few = [middle(recordings[0], actuators[0], LOOKED_AT * (natural_time(actuators[0]) or USUAL))]
    best, hidden = _nearest(actuators, few, effects)
    model = actuators[[each.name for each in actuators].index(best.model.name)]
    ramp = own_ramp(best, few)
    return _all_free(model if ramp is None else _with_ramp(model, ramp)), hidden


def _all_free(model: Model) -> Model:
    """`model` with all parameters estimated that are not exactly known: few suffice to choose the loop, all describe
    it."""
    return model.change(estimated=[each.name for each in model.parameters if each.std > 0.0])


def _nearest(
    actuators: Sequence[Model], few: Sequence[Recording], effects: Sequence[Effect]
) -> tuple[FullFit, tuple[str, ...]]:
    """The likeliest fit, possibly with one of the effects that its lag is confounded with, and all of these that may be
    missing."""
    bases = []
    for model in actuators:
        workspace = Workspace.of(model, few, None, effects)
        try:
            bases.append((full(model, workspace), workspace))
        except FAILURES:
            continue
    if not bases:
        raise ArithmeticError("no model of the actuators can be fitted")
    tried = [_tried(alone, workspace, effects) for alone, workspace in bases]
    return max(tried, key=lambda each: each[0])[1:]


def _tried(alone: FullFit, workspace: Workspace, effects: Sequence[Effect]) -> tuple[float, FullFit, tuple[str, ...]]:
    """The evidence for a model with the effects that suit it best, its likeliest fit with at most one of the effects
    with which its lag is confounded, and which of these may be missing in it."""
    late = [each.name for each in effects if each.delay or each.lag]
    fits = confounded.fits(alone, workspace, late)
    better = [each for each in fits if likelier(each.evidence - alone.evidence) and not small(each.fitted)]
    wider = confounded.together(alone.model, workspace, [each.name for each in effects if each.name not in late])
    evidence = max(each.evidence for each in (alone, *fits, *wider)) - _order(alone)
    return evidence, max((alone, *better), key=lambda each: each.evidence), tuple(each.name for each in better)


def own_ramp(found: FullFit, recordings: Sequence[Recording]) -> float | None:
    """The ramp, unit/s^2, with which the model of `found` explains `recordings` best; None if these do not show one.

    A ramp that ends within its sample does what any other does, times a number. One that takes longer has a shape.
    """
    ramped = [each for each in found.model.inputs if each.ramp_of]
    changes = [np.abs(np.diff(each[ramped[0].channel])) / np.diff(each.time) for each in recordings if ramped]
    if not changes:
        return None
    fastest, usual = float(np.nanmax(np.concatenate(changes))), ramped[0].ramp
    if np.mean(np.concatenate(changes) > usual) < LONGER:
        return None
    start = found.fitted

    def cost(logarithm: float) -> float:
        model = _with_ramp(start, float(np.exp(logarithm)))
        try:
            return -full(model, Workspace.of(model, recordings, None, ())).log_likelihood
        except FAILURES:
            return np.inf

    # The cost is steep within a tenth of the right ramp and nearly flat far from it: so the search is a fine one.
    bounds = (float(np.log(min(usual, fastest) / SLOWER)), float(np.log(fastest)))
    return float(np.exp(minimize_scalar(cost, bounds=bounds, method="bounded", options={"xatol": 2e-3}).x))


def _with_ramp(model: Model, ramp: float) -> Model:
    return replace(model, inputs=tuple(replace(each, ramp=ramp) if each.ramp_of else each for each in model.inputs))


def over_noise(alone: FullFit) -> float:
    """The innovations' standard deviation over the sensor's, of the last output: the actuators' own motion."""
    return float(np.sqrt(alone.fit.covariance[-1, -1]) / sensor_noise(alone.fit.problem)[0][-1])


def _order(alone: FullFit) -> float:
    """Price of a model's own parameters: the log-likelihood has to rise by more."""
    rows = sum(map(len, alone.fit.problem.segments))
    return 0.5 * len(alone.fit.problem.free) * float(np.log(rows))


def small(fitted: Model) -> bool:
    """Whether a further lag in `fitted` is less than the formula's own error; False if there is none."""
    lags = [each.qualified(each.effect.lag) for each in fitted.effects if each.effect.lag]
    return any(fitted.parameter(name).value < lag_error(fitted) for name in lags)


def lag_error(model: Model) -> float:
    """s by which the lag of the speed loop of `model` may be off; 0 if it has none."""
    lag = speed_loop_lag(model)
    return FORMULA * model.parameter(lag).value if lag else 0.0
