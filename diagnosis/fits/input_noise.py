"""Which measured inputs have noise that does not act, by what the innovations say?

Noise of a reading that drives the model as if it acted leaves a force that goes with the reading. What is the noise of
it is told from the readings alone (estimators.fit.input_noise); whether a force that goes with that noise explains
what is left is a test of one number at each joint.
"""

from __future__ import annotations

from diagnosis.evidence import LEVEL
from diagnosis.lack_of_fit.floor import Innovations, floor
from diagnosis.lack_of_fit.force_probe import probe
from diagnosis.lack_of_fit.shapes import Design
from diagnosis.score.whitened import Whitened
from estimators.fit.input_noise import input_noise, rough
from estimators.fit.maximum_likelihood import Fit
from models.random.input_noise import InputNoise, noisy_inputs


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
    designs = [Design(white, found, probed, joint) for joint in range(len(probed.joints))]
    told = []
    for each in asked:
        columns = [part[:, None] for part in rough(task, each)]
        least = min((one.gain(one.columns(columns)).by_chance for one in designs), default=1.0)
        if least * len(asked) * len(designs) < LEVEL:
            told.append(each)
    return told
