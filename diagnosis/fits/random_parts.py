"""Random parts: does a record require a narrow-band random force at a joint, or a random error of a sensor?

A random part is a hypothesis like an effect: model states, here driven by white noise, that have to raise the
log-likelihood by more than their parameters cost (diagnosis.fits.refit). One that wins is absorbed: it joins the
disturbance of the model alone, with which effects are then searched again, and is not a finding about the vehicle. If
effects explain more without it, it is rejected: a periodic signal that continues as it began needs fewer parameters as
an effect.

Noise of a measured input is a random part, too: a share of the noise that does not act (diagnosis.fits.input_noise).

The derivative of the likelihood with respect to the RMS is zero at RMS zero, so the score test cannot see a random
part. It needs full fits, of the signals that the spectrum of the innovations shows (diagnosis.lack_of_fit.colour),
starting from their values there; if the innovations are white, nothing is fitted.
"""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial

import numpy as np

from upright.diagnosis.fits.input_noise import not_acting
from upright.diagnosis.fits.refit import FURTHER_FITS, FullFit, as_evident, full
from upright.diagnosis.lack_of_fit.colour import Signal, same, signals
from upright.diagnosis.prepare.workspace import Workspace
from upright.diagnosis.side_by_side import side_by_side
from upright.diagnosis.trial import tried
from upright.estimators.fit.innovations import NoiseModel
from upright.estimators.fit.maximum_likelihood import ENOUGH, Begin, Fit
from upright.estimators.fit.problem import Problem
from upright.models.model import Model
from upright.models.parts import NarrowBand
from upright.models.random.disturbance import narrow_at_joints, power_share, with_narrow_band
from upright.models.random.input_noise import InputNoise, with_input_noise
from upright.models.random.sensor_error import at_outputs, with_error

RANDOM = "random parts beside the disturbance"
"""Name of the random parts in `untried` if no time is left for them."""
MOST = 2
"""Signals that get a full fit, of those with most evidence."""
NEAR = 1.5
"""Factor by which a frequency may deviate from that of the spectrum: beyond it, it would be another signal."""


def expected_log_ratio(fitted: FullFit) -> float:
    """Expected rise of the log-likelihood by the best random part, from the spectrum alone; 0 if none is required."""
    return max((each.gain for each in tried(partial(signals, fitted.fit)) or []), default=0.0)


def absorbed(base: FullFit, last: FullFit, workspace: Workspace) -> FullFit | None:
    """The fit of `base`, the model alone, with the random part that is likelier with the effects of `last` than without
    a random part, or alone than these effects are; None if there is none. `last` is `base` if there is no effect."""
    beside = _likeliest(last, workspace)
    if beside is not None and beside.evidence > last.evidence:
        if base is last:
            return beside
        model = replace(beside.model, effects=base.model.effects)
        return tried(partial(full, model, workspace, begin=beside.fit.end, longer=FURTHER_FITS))
    alone = _likeliest(base, workspace) if base is not last else None
    return alone if alone is not None and alone.evidence > last.evidence else None


def _likeliest(fitted: FullFit, workspace: Workspace) -> FullFit | None:
    """The fit with one random part more than `fitted` that has most evidence."""
    candidates: list[Signal | InputNoise] = [*_distinct(tried(partial(signals, fitted.fit)) or [])]
    candidates += tried(partial(not_acting, fitted.fit)) or []
    # Compiled one after the other, before two threads need them.
    models = [tried(partial(_with, fitted.model, each, workspace)) for each in candidates]
    fits = side_by_side(partial(_continued, fitted, workspace), [each for each in models if each is not None])
    settled = [each for each in fits if each is not None and each.fit.minimum.converged and _lasts(each)]
    return max(settled, key=lambda each: each.evidence, default=None)


def _distinct(candidates: list[Signal]) -> list[Signal]:
    """The first of `candidates`, no two of which are the same signal."""
    found: list[Signal] = []
    for each in candidates:
        if len(found) < MOST and not any(same(each, other) for other in found):
            found.append(each)
    return found


def _lasts(fitted: FullFit) -> bool:
    """Whether each random part lasts: an oscillation whose correlation time ends at its lower bound is not an
    oscillation, and a signal that decays within two samples is white."""
    model = fitted.model
    places = [place for _, place in (*narrow_at_joints(model), *at_outputs(model))]
    times = {model.base_states[place].correlation_time for place in places}
    parameters, ended = fitted.fit.problem.parameters, fitted.fit.minimum
    return not any(
        each.name in times and at_bound and value <= each.lower
        for each, value, at_bound in zip(parameters, ended.common, ended.at_bound, strict=False)
    )


def _with(model: Model, part: Signal | InputNoise, workspace: Workspace) -> Model:
    """`model` with the random part, compiled."""
    wider = with_input_noise(model, part) if isinstance(part, InputNoise) else with_signal(model, part, workspace)
    workspace.problem(wider)
    return wider


def _continued(fitted: FullFit, workspace: Workspace, wider: Model) -> FullFit | None:
    """The fit of the `wider` model from the end of `fitted`; None if it fails. If it has evidence, it is exact, since
    a torque and a sensor's error about the same frequency may be almost equally likely."""

    def fit() -> FullFit:
        begin = _begin(fitted.fit, workspace.problem(wider))
        return as_evident(fitted, wider, workspace, fitted.candidate, begin, FURTHER_FITS, ENOUGH)

    return tried(fit)


def with_signal(model: Model, signal: Signal, workspace: Workspace) -> Model:
    """`model` with the random part of `signal`, for the record of `workspace`; its estimation starts there."""
    longest = max(each.duration for each in workspace.segments)
    if signal.of_sensor:
        step = float(np.median(np.diff(workspace.segments[0].time)))
        wider = with_error(model, signal.at, signal.frequency, step, longest)
    else:
        assert signal.frequency is not None
        wider = with_narrow_band(model, signal.at, NarrowBand(signal.frequency), longest)
    new = wider.base_states[len(model.base_states) :]
    name = new[0].correlation_time
    bounds = wider.parameter(name)
    time = float(np.clip(signal.time, bounds.lower, bounds.upper))
    driven = {new[-1].name: signal.rms / math.sqrt(power_share(new[-1]) * time)}
    return replace(
        wider,
        base_states=tuple(
            replace(each, process_noise=driven[each.name]) if each.name in driven else each
            for each in wider.base_states
        ),
        base_parameters=tuple(
            replace(each, lower=each.value / NEAR, upper=each.value * NEAR) if each.name == new[0].frequency else each
            for each in wider.base_parameters
        ),
    ).change({name: time})


def _begin(fitted: Fit, wider: Problem) -> Begin:
    """The end of `fitted`; what `wider` has in addition starts at its model's values."""
    before, noise = NoiseModel.of(fitted.problem), NoiseModel.of(wider)
    logarithms, ended = np.zeros(noise.size), fitted.end
    for place, number in zip(noise.noisy, noise.process_place, strict=True):
        known = before.logarithm_of(wider.model.states[place].name)
        if known is not None:
            logarithms[number] = ended.noise[known]
    logarithms[list(noise.sensor_place)] = ended.noise[list(before.sensor_place)]
    return Begin(ended.values, logarithms)
