"""Which measured inputs have noise that does not act, by what the innovations say?

Noise of a reading that drives the model as if it acted leaves a force that goes with the reading. What is the noise of
it is told from the readings alone (estimators.input_noise); whether a force that goes with that noise explains what is
left is a test of one number at each joint.
"""

from __future__ import annotations

import numpy as np
from scipy.signal import lfilter

from diagnosis.floor import Innovations, floor
from diagnosis.force_probe import probe
from diagnosis.shapes import Design
from diagnosis.whitened import Whitened
from estimators.input_noise import input_noise
from estimators.methods.prediction_error import Fit
from models.noisy_input import InputNoise, noisy_inputs

CHANCE = 1e-2
"""Probability with which noise of any of the inputs may seem not to act, where all of it does."""


def not_acting(fitted: Fit) -> list[InputNoise]:
    """Of the inputs of a fit whose noise all acts so far, those that the innovations speak against. Raises
    ArithmeticError where the model runs away from its own fit."""
    task = fitted.problem
    there = noisy_inputs(task.model)
    noises = [input_noise(task, each) for each in task.kernel.inputs if each not in there]
    asked = [each for each in noises if each is not None]
    if not asked:
        return []
    found = Innovations(fitted, floor(task, fitted.values), tuple(fitted.innovations()))
    probed, white = probe(found), Whitened.of(fitted)
    told = []
    for each in asked:
        place = task.kernel.inputs.index(each.name)
        kept = float(np.exp(-np.median(np.diff(task.segments[0].time)) / each.time))
        rough = [
            lfilter([1.0, -1.0], [1.0, -kept], segment.row_inputs[:, place] - each.level)[:, None]
            for segment in task.segments
        ]
        gains = [Design(white, found, probed, joint) for joint in range(len(probed.joints))]
        least = min((one.gain(one.columns(rough)).by_chance for one in gains), default=1.0)
        if least * len(asked) * len(gains) < CHANCE:
            told.append(each)
    return told
