"""How much of the error a revision removes, and how much remains compared with the right model, in the benchmark.

    closed = (E0 - E1) / (E0 - floor)        left = E1 / floor

E is the mean squared whitened one-step prediction error: E0 of the nominal model, E1 of the revised one, floor of the
right model, which has the effects of the plant with its shape parameters. All were fitted to the record of the case.
`closed` is calculated from a record with another excitation, `left` from the record itself. All models predict with the
right model's filter gain and are weighted by the covariance of its innovations: with a gain of its own, a model's error
would be hidden in process noise.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from upright.estimators.fit.gauss_newton import minimise
from upright.estimators.fit.maximum_likelihood import fit
from upright.estimators.fit.problem import problem
from upright.estimators.fit.released import released
from upright.models.model import Model
from upright.telemetry.recording import Recording

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Yardstick:
    """The right model's filter: gain (ny,) of each state by name, and weights (ny, ny) that whiten its innovations."""

    gain: dict[str, Array]
    weights: Array

    def energy(self, model: Model, recordings: Sequence[Recording], support: float) -> float:
        """Mean squared whitened prediction error of `model` with its present values and fitted initial states.

        Infinite if the simulation diverges.
        """
        task = problem(model, recordings, support=support)
        outputs = len(task.kernel.outputs)
        # States of effects that the right model does not have are predicted without correction.
        gain = np.array([self.gain.get(state, np.zeros(outputs)) for state in task.kernel.states])
        evaluate = partial(task.evaluate, weights=self.weights, gain=gain)
        found = minimise(
            evaluate, task.start, task.own_start, scale=task.scale, lower=task.start, upper=task.start, iterations=10
        )
        if found is None:
            return float("inf")
        rows = [len(segment) * outputs for segment in task.segments]
        errors = [block.residual[:count] for block, count in zip(found.blocks, rows, strict=True)]
        return float(np.mean(np.concatenate(errors) ** 2))


def fitted(model: Model, recordings: Sequence[Recording], support: float) -> tuple[Model, Yardstick]:
    """`model` with the values of a prediction-error fit, and its filter. Raises EstimationError and ArithmeticError."""
    found = fit(problem(model, recordings, support=support))
    if (with_more := released(model, found)) is not model:
        found = fit(problem(with_more, recordings, support=support))
    values = dict(zip(found.problem.kernel.parameters, found.values.tolist(), strict=True))
    gain = dict(zip(found.problem.kernel.states, found.gain, strict=True))
    return model.change(values), Yardstick(gain, np.linalg.inv(np.linalg.cholesky(found.covariance)))


def closed(before: float, after: float, floor: float) -> float | None:
    """The share of the excess error that is removed; None if the nominal model is not worse than the right one."""
    return (before - after) / (before - floor) if before > floor else None
