"""Random parts: does a record ask for a second random force at a joint, one of a narrow band (models.disturbance)?

A random part is a hypothesis as an effect is: model states, here driven by white noise, that have to gain more in log
likelihood than their parameters cost (diagnosis.refit). One that wins is absorbed: it joins the disturbance of the
model alone, beside which effects are then looked for anew, and is no finding about the vehicle. Where effects explain
more without it there is none: what is periodic, and goes on as it began, takes fewer numbers as an effect.

The likelihood's derivative by the RMS is zero where that is zero, so that no score test sees it. It takes full fits of
its own, which begin where the innovations of the model alone, or with the effects found, have too much power. Where
these are white nothing is fitted. The test: in blocks of 1, 2, 4, ... lines of the periodogram, a white signal's power
has a chi-squared distribution; the least likely block of all tells frequency and width.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from diagnosis.floor import sensor_noise
from diagnosis.reach import reach
from diagnosis.refit import FURTHER_FITS, FullFit, full
from diagnosis.trial import tried
from diagnosis.where_it_fails import LEVEL
from diagnosis.whitened import PEAKS, SLOWEST, Whitened, of_longest
from diagnosis.workspace import Workspace
from estimators.innovations import NoiseModel
from estimators.methods.prediction_error import Begin, Fit
from estimators.problem import Problem
from estimators.time_scale import time_scale
from models.disturbance import at_joints, narrow_at_joints, with_narrow_band
from models.model import Joint, NarrowBand

Array = NDArray[np.float64]

RANDOM = "a random force of a narrow band"
"""What it is called where there was no time for it."""


def absorbed(base: FullFit, last: FullFit, workspace: Workspace) -> FullFit | None:
    """The fit of `base`, the model alone, with the random part that is likelier beside the effects of `last` than none
    is, or alone than these are; None where there is none."""
    beside = _likeliest(last, workspace)
    if beside is not None and beside.evidence > last.evidence:
        if base is last:
            return beside
        model = replace(beside.fitted, effects=base.model.effects)
        return tried(partial(full, model, workspace, longer=FURTHER_FITS))
    alone = _likeliest(base, workspace) if base is not last else None
    return alone if alone is not None and alone.evidence > last.evidence else None


def _likeliest(fitted: FullFit, workspace: Workspace) -> FullFit | None:
    """The fit with one random part more than `fitted` has that has most evidence, from all peaks of its innovations."""
    shaken = {joint.name for joint, _ in narrow_at_joints(fitted.model)}
    joints = [joint for joint, _ in at_joints(fitted.model) if joint.name not in shaken]
    if not joints:
        return None
    peaks = tried(partial(too_strong, fitted.fit)) or []
    fits = [tried(partial(_with, fitted, joint, each, workspace)) for joint in joints for each in peaks]
    settled = [each for each in fits if each is not None and each.fit.minimum.converged and _narrow(each)]
    return max(settled, key=lambda each: each.evidence, default=None)


def _narrow(fitted: FullFit) -> bool:
    """Whether the forces of a narrow band are of one: what ends at the shortest time for which they may swing on, is no
    swing."""
    times = {fitted.model.base_states[place].correlation_time for _, place in narrow_at_joints(fitted.model)}
    parameters, ended = fitted.fit.problem.parameters, fitted.fit.minimum
    return not any(
        each.name in times and at_bound and value <= each.lower
        for each, value, at_bound in zip(parameters, ended.common, ended.at_bound, strict=False)
    )


def _with(fitted: FullFit, joint: Joint, frequency: float, workspace: Workspace) -> FullFit:
    longest = max(each.duration for each in workspace.segments)
    model = with_narrow_band(fitted.model, joint.name, NarrowBand(frequency), longest)
    begin = _begin(fitted.fit, workspace.problem(model))
    return full(model, workspace, fitted.candidate, begin, longer=FURTHER_FITS)


def _begin(fitted: Fit, wider: Problem) -> Begin:
    """Where `fitted` ended, with what `wider` has beside as its model says."""
    before, noise = NoiseModel.of(fitted.problem), NoiseModel.of(wider)
    logarithms, ended = np.zeros(noise.size), fitted.end
    for place, number in zip(noise.noisy, noise.process_place, strict=True):
        known = before.logarithm_of(wider.model.states[place].name)
        if known is not None:
            logarithms[number] = ended.noise[known]
    logarithms[list(noise.sensor_place)] = ended.noise[list(before.sensor_place)]
    return Begin(ended.values, logarithms)


def too_strong(fitted: Fit) -> list[float]:
    """Frequencies, Hz, about which the innovations have most power, as far as a force shows there; none where so much
    as the least likely of them has is what chance gives white ones.

    Blocks of a dyadic scale are not independent, so that LEVEL is the most that chance finds (Bonferroni).
    """
    task = fitted.problem
    segment, rows = of_longest(Whitened.of(fitted))
    # A noise that is stated is stated too large: what is left of it has no power.
    told = [place for place, each in enumerate(task.model.outputs) if not each.noise_known]
    chosen = told or list(range(rows.shape[1]))
    lines = np.fft.rfft(rows[:, chosen], axis=0)[1:-1]
    power: Array = np.sum(np.square(lines.real) + np.square(lines.imag), axis=1) / len(rows)
    spacing = float(np.median(np.diff(segment.time)))
    frequency = np.arange(1, len(lines) + 1) / (len(rows) * spacing)
    fastest = float(np.max(reach(task, fitted.values, sensor_noise(task)[0])[chosen]))
    kept = (frequency >= SLOWEST / time_scale(task.model, task.segments)) & (frequency <= fastest)
    blocks = sorted(_blocks(frequency[kept], power[kept], len(chosen)))
    if not blocks or blocks[0][0] >= LEVEL / len(blocks):
        return []
    found: list[tuple[float, float]] = []
    for _, low, high in blocks:
        if all(high < other_low or low > other_high for other_low, other_high in found):
            found.append((low, high))
    return [0.5 * (low + high) for low, high in found[:PEAKS]]


def _blocks(frequency: Array, power: Array, outputs: int) -> Iterator[tuple[float, float, float]]:
    """Probability of so much power, and the first and last frequency, of each block; `power` (n,) of all outputs."""
    lines = 1
    while 2 * lines <= len(power):
        sums = power[: len(power) // lines * lines].reshape(-1, lines).sum(axis=1)
        # A line's power in one output is half that of two independent parts.
        chances = chi2.sf(2.0 * sums, 2 * lines * outputs)
        for place, chance in enumerate(chances.tolist()):
            yield chance, float(frequency[place * lines]), float(frequency[(place + 1) * lines - 1])
        lines *= 2
