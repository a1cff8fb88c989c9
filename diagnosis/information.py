"""What a record says about the parameters of a model: the Fisher information of its innovations.

    information = sum over samples of  (de/dp)' S^-1 (de/dp),   less what the unknown initial state takes of it

e are the one-step errors of the predictor with the noise that the model states, S their covariance, p the parameters
that the model estimates. The inverse is the least covariance that estimates from such a record can have (Cramer, Rao).
A recording need not exist: the record may be predicted. Source: Ljung, "System identification", 2nd ed., section 9.4.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from upright.diagnosis.prediction.closed_loop import Experiment, simulate
from upright.diagnosis.rivals import NOTHING_MORE, Rival
from upright.estimators.contract import EstimationError
from upright.estimators.fit.innovations import NoiseModel
from upright.estimators.fit.problem import problem
from upright.models.model import Model
from upright.models.segment import Segment

Array = NDArray[np.float64]


class NoPredictorError(EstimationError):
    """A model has no stable predictor, or diverges."""


@dataclass(frozen=True, slots=True)
class Information:
    """`matrix` (p, p) of the parameters `names`, in the inverse squares of their units."""

    names: tuple[str, ...]
    matrix: Array

    def deviations(self) -> dict[str, float]:
        """Least standard deviations of estimates by name, in the parameters' units; inf if one is not determined."""
        try:
            variances = np.diag(np.linalg.inv(self.matrix))
        except np.linalg.LinAlgError:
            variances = np.full(len(self.names), np.inf)
        return {name: float(np.sqrt(v)) if v > 0.0 else np.inf for name, v in zip(self.names, variances, strict=True)}


def information(model: Model, rows: Segment) -> Information:
    """Of the samples `rows`, which `model` predicts. Raises NoPredictorError."""
    task = problem(model, (), rows=[rows])
    noise, values = NoiseModel.of(task), task.kernel.vector()
    rival = Rival.assumed(NOTHING_MORE, model)
    nominal = rival.logarithms(noise)
    gain = noise.gain(values, nominal)
    if gain is None:
        raise NoPredictorError(f"model {model.name}", "no filter of it is stable", remedy="check its noise.")
    covariance = rival.covariance(noise, values, nominal, gain)
    weights = np.asarray(np.linalg.inv(np.linalg.cholesky(covariance)))
    blocks = task.evaluate(task.start, task.own_start, weights=weights, gain=gain)
    if blocks is None:
        raise NoPredictorError(f"model {model.name}", "it diverges", remedy="check its parameter values.")
    matrix = np.zeros((len(task.free), len(task.free)))
    for block in blocks:
        of_start = np.linalg.solve(block.own.T @ block.own, block.own.T @ block.common)
        matrix += block.common.T @ block.common - block.common.T @ block.own @ of_start
    return Information(tuple(each.name for each in task.parameters), matrix)


def predicted_information(model: Model, experiment: Experiment) -> Information:
    """Of a run of `experiment` as `model` predicts it; without its noise, which adds nothing on average.

    Raises NoPredictorError, also if the experiment comes too close to a limit.
    """
    course = simulate(model, experiment)
    if course.broken:
        raise NoPredictorError(f"experiment {experiment.name}", course.broken, remedy="make it smaller.")
    return information(model, course.rows)
