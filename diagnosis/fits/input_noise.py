"""Which measured inputs have noise that does not act on the vehicle, according to the innovations?

A model is driven by an input's reading, noise included, as if the noise acted. If it does not act, it leaves a force
that is correlated with the reading. The noise of the reading is estimated from the readings alone
(estimators.fit.random.input_noise); whether a force proportional to that noise explains the remaining innovations is a
test of one number at each joint.
"""

from __future__ import annotations

from upright.diagnosis.evidence import LEVEL
from upright.diagnosis.lack_of_fit.floor import Innovations, floor
from upright.diagnosis.lack_of_fit.force_probe import probe
from upright.diagnosis.lack_of_fit.shapes import Design
from upright.diagnosis.score.whitened import Whitened
from upright.estimators.fit.maximum_likelihood import Fit
from upright.estimators.fit.random.input_noise import input_noise, rough
from upright.models.random.input_noise import InputNoise, noisy_inputs


def not_acting(fitted: Fit) -> list[InputNoise]:
    """Of the inputs of a fit whose noise all acts so far, those for which the innovations contradict that. Raises
    ArithmeticError if the model diverges at the values of its own fit."""
    task = fitted.problem
    there = noisy_inputs(task.model)
    noises = [input_noise(task, each) for each in task.kernel.inputs if each not in there]
    known = [each for each in noises if each is not None]
    if not known:
        return []
    found = Innovations(fitted, floor(task, fitted.values), tuple(fitted.innovations()))
    probed, white = probe(found), Whitened.of(fitted)
    designs = [Design(white, found, probed, joint) for joint in range(len(probed.joints))]
    rejected = []
    for each in known:
        columns = [part[:, None] for part in rough(task, each)]
        least = min((one.gain(one.columns(columns)).by_chance for one in designs), default=1.0)
        if least * len(known) * len(designs) < LEVEL:
            rejected.append(each)
    return rejected
